"""What the vector kernels are written in: four lanes, Jacobi's eigenvalues, one filter."""
