"""Parts of `render_demo_scene.py`: a seeded street scene, its rendering, and its ground truth in KITTI's layout."""
