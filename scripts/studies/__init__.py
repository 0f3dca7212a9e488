"""The studies behind the pages in docs/: one package each, run by the command beside this folder that its `__init__` names."""
