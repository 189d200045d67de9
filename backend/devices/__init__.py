"""What the bench needs from hardware, and who provides it."""
