"""Reports of studies, runs and tunings: results, tables, figures and pages."""
