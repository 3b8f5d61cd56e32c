"""The command: makes the env, loads the policy, diagnoses, prints, and writes page and JSON."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from rich.console import Console

from safe_wrappers.diagnosis import Diagnosis, diagnose

from ..figures.plot_files import PlotFiles
from ..run.stack import make_env
from .page import diagnosis_page
from .trained import of_file, of_run


def diagnose_command(
    env_id: str,
    policy: Path | None,
    steps: int,
    output: Path,
    command: str,
    console: Console,
    imports: Collection[str] = (),
) -> Diagnosis:
    """Diagnose an env by its id, and write the page, and beside it the same as JSON and its plots as CSV.

    Args:
        env_id: As `gym.make` takes it.
        policy: A run's folder, or a model.zip; None: random and attacking drivers alone.
        steps: Control steps of each driver.
        output: The page.
        command: For the page.
        console: Where the table goes.
        imports: As `load_policy` takes it.
    """
    acts: Any = None
    if policy is not None and policy.suffix != ".zip":
        env, acts = of_run(policy, env_id, imports)
    else:
        env = make_env(env_id, {})
        acts = acts if policy is None else of_file(policy)
    found = diagnose(env, acts, steps)
    env.close()
    output.parent.mkdir(parents=True, exist_ok=True)
    output.with_suffix(".json").write_text(found.as_json())
    files = PlotFiles(output)
    output.write_text(diagnosis_page(found, command, files))
    files.write()
    console.print(str(found), highlight=False, markup=False, soft_wrap=True)
    console.print(f"Page: {output}", highlight=False, soft_wrap=True)
    return found
