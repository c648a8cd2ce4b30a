"""The package that uses all others: scenario files, runs, scores, the suite and the command line.

``run_scenario`` runs a scenario from Python and returns record, tracks and truth.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.run.library import run_scenario

__all__ = ["run_scenario"]


def __getattr__(name: str) -> Any:
    """Import the modules that run scenarios at their first use."""
    if name == "run_scenario":
        import scenarios.run.library as library

        return library.run_scenario
    raise AttributeError(f"module 'scenarios' has no attribute '{name}'")
