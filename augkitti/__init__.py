"""Augmented KITTI: virtual cars with exact motion labels in real LiDAR scans; numpy arrays in and out."""

__version__ = "0.1.0"
