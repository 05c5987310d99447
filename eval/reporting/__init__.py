"""Tables, verdicts, figures and the page. Start in ``report.py``."""
