"""Many drives and vehicles on Dask: resumable, and one page for the fleet."""
