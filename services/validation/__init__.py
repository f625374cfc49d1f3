"""Is what the methods say true? Against the paper, a known truth, and a bound."""
