"""A reader that is not ours and not in Python: `@mcap/core` for JavaScript counts the same messages."""

import json
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S

PACKAGES = ("@mcap/core@2.2.2", "fzstd@0.1.1")

COUNT = """
const fs = require("fs/promises");
const { McapIndexedReader } = require("@mcap/core"), fzstd = require("fzstd");
(async () => {
  const handle = await fs.open(process.argv[2], "r");
  const readable = {
    size: async () => BigInt((await handle.stat()).size),
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      await handle.read(buffer, 0, Number(length), Number(offset));
      return buffer;
    },
  };
  const decompressHandlers = { zstd: (data, size) => fzstd.decompress(data, new Uint8Array(Number(size))) };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const counts = {};
  for await (const message of reader.readMessages()) {
    const topic = reader.channelsById.get(message.channelId).topic;
    counts[topic] = (counts[topic] ?? 0) + 1;
  }
  const attachments = [];
  for await (const attachment of reader.readAttachments()) attachments.push(attachment.name);
  const headers = [];
  for await (const record of reader.readMetadata({ name: "brushloop.header" })) {
    headers.push(record.metadata.get("brush"));
  }
  console.log(JSON.stringify({ counts, attachments, headers }));
  await handle.close();
})();
"""


def test_the_documented_lines_are_those_that_are_run_here() -> None:
    text = (Path(__file__).parents[2] / "docs" / "session-format.md").read_text(encoding="utf-8")
    [block] = re.findall(r"^```js\n(.*?)^```", text, re.M | re.S)
    assert len(block.splitlines()) == 3
    assert [line for line in block.splitlines() if line not in COUNT] == []


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    """A folder with the reader installed, outside the tree; npm's own cache makes the second time quick."""
    if not (shutil.which("node") and shutil.which("npm")):
        pytest.skip("node and npm are not installed")
    folder = tmp_path_factory.mktemp("node")
    command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefer-offline", *PACKAGES]
    try:
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        pytest.skip("npm did not fetch @mcap/core within 60 s")
    if ran.returncode != 0:
        pytest.skip(f"npm cannot install {' '.join(PACKAGES)}: {(ran.stderr.strip().splitlines() or ['?'])[-1]}")
    (folder / "count.js").write_text(COUNT)
    return folder


def test_the_javascript_reader_counts_the_same(make, store, node):
    make.collect(store)
    final = store.close()
    ran = subprocess.run(
        ["node", "count.js", final], cwd=node, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    topics = Counter(topic for topic, *_ in make.messages(final).elements())
    assert found["counts"] == dict(topics)
    assert sorted(found["attachments"]) == sorted(make.snapshots)
    assert found["headers"] == ['"goat"']
