"""The method: patch, belief, stability, action as pure functions of values."""
