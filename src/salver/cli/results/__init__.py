"""Commands that show or export a result: page, figures, film, motion files."""
