"""Many patients at once: the steps for each (``steps``), how they are run (``engine``), and the
tables made of them (``results``)."""
