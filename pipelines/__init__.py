"""Staged jobs over the `augkitti` library: a KITTI folder in, a data set folder out."""
