"""Reading and writing files: data sets in KITTI's and other layouts, masks, results and manifests.

What is missing, damaged or not as its format demands raises `DataFormatError`, which names the file, the line where it
has lines, and a cure; wrong arguments raise `InputError`.
"""
