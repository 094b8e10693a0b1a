"""Many patients at once: what is done for each (``steps``), by whom (``engine``), and what came of
it (``results``)."""
