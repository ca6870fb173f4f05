"""Reading and writing files: data sets in KITTI's layout, masks, results and manifests."""
