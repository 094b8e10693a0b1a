"""The method of the preset `clinic`; read ``registration`` first, which names the steps."""
