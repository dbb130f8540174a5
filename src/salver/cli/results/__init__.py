"""Commands that show or hand over a result: page, figures, film, motion files."""
