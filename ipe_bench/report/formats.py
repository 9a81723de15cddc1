"""Names the formats of figures and tables, once for those who write them, for help, and for
refusals."""

PAGE = "png"
"""The format of figures that is always written, as the page shows it."""
FIGURES = (PAGE, "pdf", "svg")
"""Formats of figures."""
TABLES = ("csv", "md", "tex")
"""Formats of tables: the first is always written."""
FORMATS = (*FIGURES, *TABLES)
MEANING = (
    f"further formats of figures ({', '.join(FIGURES[1:])}) and tables ({', '.join(TABLES[1:])})"
)
"""What help says of `formats=`."""
