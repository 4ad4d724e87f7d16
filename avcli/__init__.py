"""Unix filters that simulate, sense, track and score people who walk and talk in a room."""

__version__ = "0.1.0"
