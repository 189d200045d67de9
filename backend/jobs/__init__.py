"""Units of work that are named by what they depend on, and the executors that run them."""
