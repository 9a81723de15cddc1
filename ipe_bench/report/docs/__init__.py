"""The documentation: pages about ipe-bench, a reference read from the code, and a gallery of executed experiments.

`make docs` builds the site into outputs/docs/html; what a page says of options, statuses and statistics is taken from
where the program itself takes it. Needs the extra `docs`.
"""
