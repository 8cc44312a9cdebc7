"""Work beyond one machine, on the workers of a Dask cluster; Dask is imported only where it is asked for."""
