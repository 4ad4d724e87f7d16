"""The formats that cross the border: records, config.json, pictures, sound and films, and files written whole."""
