"""The schema of `--json`: it is one, it has every command, and it refuses what is not what a command prints."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import fake_diagnosis
import jsonschema
import pytest
from schema import matches
from test_run_tools import ANSWER, RESULT, run

from figaroh_jax import cli
from figaroh_jax.reporting.answer import answer

SCHEMA = json.loads((resources.files("figaroh_jax") / "json_schema.json").read_text(encoding="utf-8"))


def test_the_schema_is_one_and_has_every_command_that_prints_json():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    commands = next(action for action in cli._parser()._actions if action.dest == "command").choices
    printing = {name for name, parser in dict(commands or {}).items() if "--json" in parser.format_help()}
    assert printing - {"rerun", "export"} <= SCHEMA["$defs"].keys()  # rerun prints what the command does


@pytest.mark.parametrize("variant", ["named", "partly", "unknown", "nothing"])
def test_answers_match(variant: str):
    matches("diagnose", json.loads(json.dumps(answer(getattr(fake_diagnosis, variant)()))))


def test_an_answer_without_its_verdict_or_with_a_cause_that_is_none_is_refused():
    whole = json.loads(json.dumps(answer(fake_diagnosis.named())))
    for wrong in ({k: v for k, v in whole.items() if k != "verdict"}, {**whole, "causes": [{"effect": "x"}]}):
        with pytest.raises(jsonschema.ValidationError):
            matches("diagnose", wrong)


def test_what_the_tools_print_matches(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    task = tmp_path / "task.yaml"
    task.write_text("robot: {}")
    one, two = run(tmp_path / "one", task, answer=ANSWER), run(tmp_path / "two", task, result=RESULT)
    for command in (["verify", str(one)], ["compare", str(one), str(two)], ["list", str(tmp_path)]):
        cli.main([*command, "--json"])
        matches(command[0], json.loads(capsys.readouterr().out))
    matches("provenance", json.loads((one / "provenance.json").read_text()))
