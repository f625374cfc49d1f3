"""A Dask scheduler and its workers on this machine."""
