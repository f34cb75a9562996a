"""Small logs that other libraries wrote, and what makes them (`make.py`)."""
