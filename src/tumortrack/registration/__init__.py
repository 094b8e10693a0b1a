"""The method of the preset `elastic`; read ``registration`` first, which names the steps."""
