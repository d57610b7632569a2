"""Reports: pages, tables, texts and figures, from the run folder alone."""
