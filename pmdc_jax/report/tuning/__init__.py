"""The report of a tuning: sentences, tables, figures, the HTML page, JSON."""
