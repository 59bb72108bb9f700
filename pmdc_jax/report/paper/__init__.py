"""The report of the reproduced paper: sentences, tables, figures, the HTML page, JSON."""
