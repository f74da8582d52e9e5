import gknet.io.openmp  # noqa: F401  (before anything here imports torch)
