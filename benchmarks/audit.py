"""Asks for known vulnerabilities of the packages in requirements.lock, and says how many could be asked about.

    make audit

pip-audit calls packages that it could not ask about free of known vulnerabilities; here they are counted.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

COMMAND = (
    "pip-audit",
    "-r",
    "requirements.lock",
    "--require-hashes",
    "--disable-pip",
    "--progress-spinner",
    "off",
)


def verdict(report: dict[str, Any] | None) -> tuple[int, list[str]]:
    """Exit status and lines for what pip-audit has reported, None if it could not."""
    packages = [] if report is None else report["dependencies"]
    asked = [package for package in packages if "skip_reason" not in package]
    if not asked:
        return 0, [
            "Audit: nobody could be asked (no network, or one without that service). Nothing was checked."
        ]
    lines = [
        f"{package['name']} {package['version']}: {found['id']}, mended in {', '.join(found['fix_versions']) or '-'}"
        for package in asked
        for found in package["vulns"]
    ]
    left = [package["name"] for package in packages if package not in asked]
    word = f"Audit: {len(asked)} packages asked about, {len(lines)} known vulnerabilities."
    if left:
        word += f" Not checked: {len(left)} ({', '.join(left)})."
    return int(bool(lines)), [*lines, word]


def main(tools: str) -> int:
    """Runs the pip-audit in a folder of programs, prints the verdict, returns its exit status."""
    command = [str(Path(tools) / COMMAND[0]), *COMMAND[1:], "-f", "json"]
    done = subprocess.run(command, capture_output=True, text=True)
    try:
        report = json.loads(done.stdout)
    except ValueError:
        report = None
        print(done.stderr[-300:], file=sys.stderr)
    status, lines = verdict(report)
    print("\n".join(lines))
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
