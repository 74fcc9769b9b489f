"""One reader per format of data files; each makes ``rows.Rows``, and ``formats.load`` chooses among them."""
