"""The report: tables, figures and one page, rebuilt from what is stored."""
