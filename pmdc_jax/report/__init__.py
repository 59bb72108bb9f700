"""Results made readable as HTML, terminal tables and JSON: presentation, no computing."""
