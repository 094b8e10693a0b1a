"""Parts of the web viewer: scene, panel, access control."""
