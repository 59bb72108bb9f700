"""The report of a diagnosis: sentences, tables, figures, the HTML page, JSON."""
