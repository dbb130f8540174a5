"""Commands that show or export a result: page, film, motion files."""
