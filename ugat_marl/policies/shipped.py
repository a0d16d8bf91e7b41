"""Trained policies that come with the package, each with a card that says how it was made.

A shipped policy is two files of one name in a folder that is called as its scenario: the policy
itself, ``NAME.pt``, and its card, ``NAME.json``. Its id is ``SCENARIO/NAME``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ugat_marl.errors import CheckpointError, UnknownNameError
from ugat_marl.files import read_json, write_whole
from ugat_marl.policies.network_policy import NetworkPolicy
from ugat_marl.policies.own_names import is_own
from ugat_marl.policies.rules.catalogue import RULES
from ugat_marl.policies.rules.named import rule_in

FOLDER = Path(__file__).parent / "shipped"
"""Folder of the shipped policies; it holds a folder for each scenario."""

VERSION = 1
"""Version of the form of cards."""


@dataclass(frozen=True)
class CardScores:
    """Scores of a policy in one domain.

    Attributes:
        episodes: Number of episodes.
        att_s: Average travel time in s, mean over the episodes.
        low_s: Lower end of its 95 % interval over the episodes, in s.
        high_s: Upper end.
        throughput: Vehicles that arrived, mean over the episodes.
    """

    episodes: int
    att_s: float
    low_s: float
    high_s: float
    throughput: float


@dataclass(frozen=True)
class PolicyCard:
    """Origin and scores of a trained policy.

    Attributes:
        id: ``SCENARIO/NAME``, as `load_policy` takes it.
        setting: Name of its row in tables, such as "fitted street".
        scenario: The scenario as the training named it.
        scenario_hashes: Domain to hash of the scenario in that domain, of all domains in `scores`.
        sim: The simulation it was trained in.
        real: The real domain it was trained for; None if it knows of none.
        training_seed: Seed of the training.
        episodes: Number of training episodes.
        learner: Name of the learner.
        command: Command that trained it.
        scores: Scores by domain.
        first_seed: Seed of the first episode of each score; the others follow.
        duration_s: Length of these episodes in s; None for the scenario's own.
        versions: Package to version in the environment that packed it.
        sha256: Hash of the file of the policy.
        job: All settings of the training, as the ``job.json`` of its folder has them.
        version: `VERSION`.
    """

    id: str
    setting: str
    scenario: str
    scenario_hashes: Mapping[str, str]
    sim: str
    real: str | None
    training_seed: int
    episodes: int
    learner: str
    command: str
    scores: Mapping[str, CardScores]
    first_seed: int
    duration_s: float | None
    versions: Mapping[str, str | None]
    sha256: str
    job: Mapping[str, Any]
    version: int = VERSION

    def write(self, path: Path) -> None:
        """Write the card as JSON atomically."""
        write_whole(path, json.dumps(asdict(self), indent=1, allow_nan=False) + "\n")

    @classmethod
    def read(cls, path: Path) -> PolicyCard:
        """Read a card.

        Raises:
            CheckpointError: The file is missing, damaged, or of another form.
        """
        content = read_json(path, CheckpointError)
        if isinstance(content, dict) and (version := content.get("version", VERSION)) != VERSION:
            raise CheckpointError(
                f"{path}: a card of version {version}, this package reads {VERSION}; copy the one "
                "of your version"
            )
        try:
            return TypeAdapter(cls).validate_python(content)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise CheckpointError(
                f"{path}: not the card of a policy ({where}: {first['msg']}); copy it again"
            ) from None


def shipped_policies(folder: Path = FOLDER) -> dict[str, Path]:
    """Return the files of the shipped policies by their ids, sorted."""
    return {
        f"{path.parent.name}/{path.stem}": path
        for path in sorted(folder.glob("*/*.pt"))
        if path.with_suffix(".json").is_file()
    }


def load_policy(name: str | Path, *, folder: Path = FOLDER) -> NetworkPolicy:
    """Return a trained policy.

    Args:
        name: Id of a shipped policy, such as ``"single-v1/direct-transfer-s0"``, or a file that a
            training wrote, ``policies/*.pt``.
        folder: Folder of shipped policies; the package's own by default.

    Returns:
        The policy: ``policy.act(observations, infos)`` gives the actions of all agents. Make its
        environment with ``ugat_marl.parallel_env(scenario, domain, **policy.env_options)``.

    Raises:
        UnknownNameError: There is no such policy.
        CheckpointError: The file is damaged, no policy, or holds a rule.
    """
    own, at, _ = str(name).partition("@")
    if at and is_own(own):
        raise CheckpointError(
            f"{name} is what a learner of yours has saved, which no other program can read; "
            "commands that play policies take it as it is"
        )
    path = Path(name)
    if path.suffix == ".pt" or path.is_file():
        if (spec := rule_in(path)) is not None:
            raise CheckpointError(
                f"{path}: holds the rule {spec}, which has no network to load or to export; "
                "ugat_marl.evaluate and commands that play policies take the file or the rule"
            )
        return NetworkPolicy.load(path)
    if path.is_dir():
        raise CheckpointError(f"{path}: a folder; name a file in it, such as policies/*.pt")
    if str(name).partition(":")[0] in RULES:
        raise CheckpointError(
            f"{name} is a rule, which has no network to load or to export; commands that play "
            "policies take it as it is"
        )
    known = shipped_policies(folder)
    if str(name) not in known:
        raise UnknownNameError(
            "policy", str(name), known, "The file of a trained policy (.pt) works as well."
        )
    file = known[str(name)]
    card = _card_of(file)
    if hashlib.sha256(file.read_bytes()).hexdigest() != card.sha256:
        raise CheckpointError(
            f"{file}: not the policy of its card (the hashes differ); install the package again"
        )
    return NetworkPolicy.load(file)


def policy_card(name: str, *, folder: Path = FOLDER) -> PolicyCard:
    """Return the card of a shipped policy.

    Args:
        name: Id of the policy.
        folder: Folder of shipped policies.

    Raises:
        UnknownNameError: There is no such policy.
        CheckpointError: The card is damaged.
    """
    known = shipped_policies(folder)
    if name not in known:
        raise UnknownNameError(
            "shipped policy",
            name,
            known,
            "`ugat-marl policy pack FOLDER --out PATH` makes the cards of a training.",
        )
    return _card_of(known[name])


def _card_of(policy: Path) -> PolicyCard:
    return PolicyCard.read(policy.with_suffix(".json"))
