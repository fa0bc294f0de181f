"""The configuration as operators see it: effective, as a schema, reloaded; and secrets."""

import asyncio
import os
import tomllib
from pathlib import Path

import pytest

from robotd.config_views import MASK, as_toml, effective, masked, schema
from robotd.daemon import read_config
from robotd.errors import ConfigError
from robotd.secret_file import read_credential, read_secret
from tests.operated import operated

EXAMPLE = Path(__file__).parent.parent / "etc" / "robotd.toml"


def test_the_effective_configuration_has_every_default_and_reads_back_as_itself(tmp_path):
    config, plans = read_config(EXAMPLE)
    text = as_toml(effective(config, plans))
    path = tmp_path / "robotd.toml"
    path.write_text(text)
    again, plans_again = read_config(path)
    assert again.mission == config.mission
    assert again.safety == config.safety
    assert {name: plan.config for name, plan in plans_again.items()} == {
        name: plan.config for name, plan in plans.items()
    }
    assert "command_s = 0.2" in text
    assert "disarm_s = 120.0" in text


def test_secrets_are_masked_and_the_names_of_their_files_are_not():
    data = {"password": "hunter2", "token_file": "/etc/t", "deep": [{"api_token": "x"}], "monkey": "banana"}
    assert masked(data) == {"password": MASK, "token_file": "/etc/t", "deep": [{"api_token": MASK}], "monkey": "banana"}


def test_the_schema_knows_every_section_key_and_limit():
    found = schema()
    assert found["properties"]["safety"]["properties"]["max_speed"]["maximum"] == 0.3
    mission = found["properties"]["mission"]["properties"]
    assert mission["stop_at"]["enum"] == ["distances", "markers"]
    assert mission["identify"]["properties"]["check_digits"]["type"] == "integer"
    drivers = found["properties"]["drivers"]["additionalProperties"]["oneOf"]
    roomba = next(item for item in drivers if item["properties"]["driver"] == {"const": "roomba"})
    assert set(roomba["required"]) == {"driver", "port"}
    assert not roomba["additionalProperties"]
    unchecked = tomllib.loads(EXAMPLE.read_text())
    for section, keys in unchecked.items():
        if section != "drivers":
            assert keys.keys() <= found["properties"][section]["properties"].keys()


def test_a_secret_is_read_from_a_file_that_is_closed_to_others(tmp_path):
    path = tmp_path / "token"
    path.write_text("  s3cret\nmore\n")
    for mode in (0o600, 0o400, 0o640):
        path.chmod(mode)
        assert read_secret(path, "here") == "s3cret"
    for mode in (0o644, 0o604, 0o660, 0o602):
        path.chmod(mode)
        with pytest.raises(ConfigError, match=r"here: .*is open to other users.*chmod 0600") as caught:
            read_secret(path, "here")
        assert "s3cret" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "empty"), (b"\n\n", "empty"), (b"x" * 5000, "too long"), (b"\xff\n", "printable ASCII")],
)
def test_what_is_no_secret_is_refused(tmp_path, content, words):
    path = tmp_path / "token"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match=words):
        read_secret(path, "here")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_secret(tmp_path / "none", "here")
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(ConfigError, match="no plain file"):
        read_secret(tmp_path / "pipe", "here")


def test_a_secret_comes_from_the_service_managers_credentials(tmp_path, monkeypatch):
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    with pytest.raises(ConfigError, match="LoadCredential=upload-token:FILE"):
        read_credential("upload-token", "here")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    with pytest.raises(ConfigError, match="no credential 'upload-token'"):
        read_credential("upload-token", "here")
    (tmp_path / "upload-token").write_text("s3cret\n")
    assert read_credential("upload-token", "here") == "s3cret"


# ---- reload ----------------------------------------------------------------------------------------------------------

TEXT = """
[robot]
name = "trial"
state_directory = "state"
calibration = "calibration.toml"
[mission]
stops = [0.0, 1.0]
labels = ["a"]
[drivers.base]
driver = "roomba"
port = "/dev/robotd/base"
[drivers.eye]
driver = "v4l2"
device = "/dev/video0"
[drivers.follower]
driver = "line_follower"
camera = "eye"
[drivers.labels]
driver = "pricer"
port = 7071
"""


def reloaded(tmp_path, change):
    """What reload answers after the running configuration's file was changed."""
    answers = []
    path = tmp_path / "robotd.toml"
    path.write_text(TEXT)

    async def scenario(robot, client):
        config, _ = read_config(path)
        object.__setattr__(robot.daemon.assembly, "config", config)
        path.write_text(change(TEXT))
        answers.append(await client.call("config.reload"))
        await asyncio.sleep(0.1)
        answers.append((await client.call("config.show", effective=False))["config"])

    robot = operated(tmp_path, scenario)
    return robot, answers[0]


def test_mission_and_safety_are_taken_over_while_robotd_runs(tmp_path):
    change = lambda text: text.replace("[0.0, 1.0]", "[0.0, 2.0, 3.0]") + "[safety]\nmax_speed = 0.1\n"  # noqa: E731
    robot, answer = reloaded(tmp_path, change)
    assert answer == {"changed": ["mission", "safety"]}
    assert robot.daemon.assembly.config.mission.stops == (0.0, 2.0, 3.0)
    assert robot.daemon.control.gate.limits.max_speed == 0.1


def test_what_cannot_change_is_refused_whole_and_named(tmp_path):
    def change(text):
        return text.replace("[0.0, 1.0]", "[0.0]").replace('"trial"', '"other"').replace("/dev/video0", "/dev/video1")

    robot, answer = reloaded(tmp_path, change)
    assert "[robot], [drivers.eye] cannot change while robotd runs, so nothing was taken over" in answer["message"]
    assert robot.daemon.assembly.config.mission.stops == (0.0, 1.0)


def test_a_file_with_mistakes_changes_nothing_and_every_mistake_is_named(tmp_path):
    robot, answer = reloaded(tmp_path, lambda text: text.replace("stops", "stps") + "[safty]\n")
    assert len(answer["data"]["problems"]) >= 2
    assert robot.daemon.assembly.config.mission.stops == (0.0, 1.0)


def test_a_file_without_changes_changes_nothing(tmp_path):
    assert reloaded(tmp_path, lambda text: text)[1] == {"changed": []}
