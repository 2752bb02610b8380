"""Reports of studies and runs: results, tables, figures and pages."""
