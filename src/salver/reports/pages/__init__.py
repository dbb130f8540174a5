"""Pages: sections, charts, tables and the 3-D replay, as HTML."""
