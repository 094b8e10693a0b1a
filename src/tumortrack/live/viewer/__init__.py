"""Parts of the web viewer: scene, panel, slices of the CT, access control."""
