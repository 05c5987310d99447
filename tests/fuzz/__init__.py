"""Malformed input: seeded mutations of small valid inputs, read by every reader of the project.

A reader must accept an input or refuse it by :class:`dvo.core.errors.DvoError`; any other exception, a hang, a process
that dies or much memory is a failure. ``target.py`` says what a reader is, ``mutations.py`` what is done to its input,
``worker.py`` how a case is run, ``readers_*.py`` list the readers.
"""
