"""Method `pre`: one crossing's residuals, their noise, the posterior and its optimum."""
