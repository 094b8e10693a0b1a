"""Sources of live tracking, one file each; pyproject.toml lists them as entry points."""
