"""Published checkpoints in the layouts of this package and of diffusers."""
