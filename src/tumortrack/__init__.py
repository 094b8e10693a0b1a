"""tumortrack: kidney and tumors, located from one depth image of one side.

Millimetres everywhere; a transform is named ``b_from_a``. See docs/conventions.md.
Importing this package imports neither torch nor any other heavy library.
"""

__version__ = "0.1.0"
