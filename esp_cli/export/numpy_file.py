"""A program as one Python file that needs numpy alone."""

from __future__ import annotations

import base64
import inspect
import json
import textwrap

from esp_cli.export.program import Program
from esp_cli.export.runtime import numpy_policy

_IMPORTS = "from typing import Any\n\nimport numpy as np\n"
"""Of the runtime; those of the lines below it join them."""


def numpy_source(program: Program, comment: str, description: str) -> str:
    """Write a program as a Python file: the runtime as it is, then this policy's numbers.

    Args:
        program: the policy.
        comment: what it is, line by line.
        description: JSON with layout, actions and the worked example.
    """
    body = (
        inspect.getsource(numpy_policy)
        .partition('"""\n')[2]
        .replace(_IMPORTS, f"import base64\nimport json\nimport sys\n{_IMPORTS}")
    )
    told = comment.replace("\\", "/").replace('"""', "'''")
    weights = "\n".join(textwrap.wrap(base64.b64encode(program.weights).decode(), 112))
    return f'''"""{told}

    import policy

    action = policy.act(obs)                            # [..., D] -> [...] or [..., width]
    memory = policy.initial_memory(num_agents)          # a policy that remembers: begin an episode,
    action, memory = policy.step(obs, memory)           # and hand its memory from step to step
    action = policy.act(obs, action_mask)               # one with masks: say what is allowed, [..., A]

Run this file to check it on its worked example.
"""
{body}

DESCRIPTION = json.loads(r"""
{json.dumps(json.loads(description), indent=1, ensure_ascii=True)}
""")
"""Layout of an observation, meaning of the actions, a worked example."""

_PROGRAM = json.loads("""{json.dumps(program.describe())}""")
_WEIGHTS = """
{weights}
"""

POLICY = NumpyPolicy(_PROGRAM, base64.b64decode(_WEIGHTS))
act, step, initial_memory = POLICY.act, POLICY.step, POLICY.initial_memory


def check_example() -> bool:
    """Return whether the worked example comes out as it should."""
    example = DESCRIPTION["example"]
    action, after = step(example["observation"], example["memory"], example.get("action_mask"))
    close = np.allclose(action, example["action"], atol=1e-4) and np.allclose(after, example["memory_after"], atol=1e-4)
    print(f"action {{action.tolist()}}, expected {{example['action']}}")
    return bool(close)


if __name__ == "__main__":
    sys.exit(0 if check_example() else 1)
'''
