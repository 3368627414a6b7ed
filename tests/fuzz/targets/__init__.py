"""The formats: good examples, how they are spoiled, and how they are read."""
