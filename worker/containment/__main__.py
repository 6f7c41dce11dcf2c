"""`python -m worker.containment --plan JSON [MODULE ...]`: runs a module as contained as a stage.

Without a module it only says, on stdout, what holds; exit code 1 where the plan cannot be had.
"""

from __future__ import annotations

import runpy
import sys

from worker.containment.apply import ContainmentError, apply_plan
from worker.containment.plan import Plan


def main() -> None:
    """Confine this process, and become the module."""
    plan, arguments = Plan.of_json(sys.argv[2]), sys.argv[3:]
    try:
        contained = apply_plan(plan)
    except ContainmentError as error:
        sys.exit(str(error))
    if not arguments:
        print(contained.as_text())
        return
    sys.argv = arguments
    runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
