import dvo  # noqa: F401, decides how threads wait, before a module imports torch
