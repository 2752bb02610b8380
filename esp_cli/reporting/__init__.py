"""What studies say: results, tables, figures and pages."""
