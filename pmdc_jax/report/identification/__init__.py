"""The report of an identification: sentences, tables, figures, the HTML page, JSON."""
