"""The report of a validation as data, tables, sentences, figures, page and files."""
