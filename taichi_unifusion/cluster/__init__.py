"""Many processes and machines: a recording is cut into shards, each is fused by itself, and partial
maps are added up (Eq. 19). Work goes to an engine that exists, Dask.
"""
