"""Shards in, trained networks and scores out; filled by the PointFlowNet work, nothing here imports `pipelines`."""
