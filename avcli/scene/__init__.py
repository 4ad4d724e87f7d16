"""The scene: scenarios, people, furniture, the renderer, the film that is drawn, and the ground truth about it."""
