"""This package reads and writes files: data sets in KITTI's and other layouts, masks, results and manifests.

A file that is missing, damaged or not in the expected format raises `DataFormatError`, which names the file, the line
number if there is one, and a cure. Wrong arguments raise `InputError`.
"""
