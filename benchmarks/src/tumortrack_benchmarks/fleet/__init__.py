"""Many patients: the list (``patients``), the steps for each (``steps``), results by content and
their execution (``run``), and the tables made of them (``results``)."""
