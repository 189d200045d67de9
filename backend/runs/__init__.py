"""What the operator starts: plans, the engine that drives them, the journal."""
