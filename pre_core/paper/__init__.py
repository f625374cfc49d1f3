"""The paper's experiment and its residual, for comparison and reproduction."""
