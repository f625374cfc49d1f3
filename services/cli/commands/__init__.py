"""Commands: the options of each as a frozen dataclass, and what it runs."""
