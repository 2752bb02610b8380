"""The format of policy files, which the application writes and a task with a frozen learned agent reads.

A policy file is a safetensors file. Its metadata has the key `METADATA_KEY`, whose text is a JSON object with the keys
`format`, `version` and others.
"""

from __future__ import annotations

METADATA_KEY = "esp"
POLICY_FORMAT = "esp-policy"
POLICY_VERSION = 1
