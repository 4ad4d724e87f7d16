"""The scene: scenarios, people, furniture, the renderer, and what is written down about each frame."""
