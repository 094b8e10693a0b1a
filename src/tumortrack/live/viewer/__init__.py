"""What the web viewer is made of: the scene, the panel, slices of the CT, margins."""
