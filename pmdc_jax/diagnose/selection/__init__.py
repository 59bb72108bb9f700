"""Selection of the effects that a motor is missing."""
