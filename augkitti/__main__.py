"""`python -m augkitti` is the `augkitti` command.

The library knows no command: it is found by name when this module is run, and never when it is imported.
"""

import runpy

if __name__ == "__main__":
    runpy.run_module("pipelines", run_name="__main__")
