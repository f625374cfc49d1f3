"""Building blocks of the vector kernels: four lanes, Jacobi eigenvalues, one filter."""
