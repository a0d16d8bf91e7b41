"""How f and h are trained."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from ugat_marl.errors import OptionError
from ugat_marl.grounding.uncertainty import Method, MethodName

PAIRS = ("observed", "smoothed")


@dataclass(frozen=True)
class FitConfig:
    """How the models are trained.

    Attributes:
        uncertainty: How h says that it is unsure: "edl" (evidential), "dropout" (Concrete Dropout),
            "ensemble" (Deep Ensembles), or "none", with which every grounded action is taken.
        pairs: What h learns from in phase grounding: "observed" transitions, as in the paper, or
            "smoothed" ones (s, what a model of the simulation expects of a). f, whose output h has
            to read, predicts means; single transitions scatter around them.
        members: Networks of an ensemble.
        passes: Thinned networks that dropout averages over.
        epochs: Most passes over the training rows.
        batch_size: Rows per agent and update.
        learning_rate: Of Adam.
        patience: Epochs without a lower held-out loss after which training ends.
        held_out_every: Every n-th episode is held out; of a single episode, the last n-th part.
        kl_epochs: Epochs over which the divergence term of the evidential loss and the certainty on
            invented inputs are annealed in.
        kl_weight: Final weight of that divergence, for "edl"; 1 is Sensoy et al. With eight phases
            that often look alike, 1 keeps h from learning: on grid2x2-v1 its held-out accuracy is
            0.60 (u 0.90, AUROC of u 0.72) against 0.70 (0.48, 0.73) at 0.1.
        off_data_weight: Weight of the certainty h shows on invented inputs (`off_data`), for all
            but "none"; 0 is each method as its paper has it, under which u need not rise off the
            data.
        warm_start: Go on from the current weights instead of drawing new ones.
    """

    uncertainty: MethodName = "edl"
    pairs: Literal["observed", "smoothed"] = "observed"
    members: int = 5
    passes: int = 20
    epochs: int = 100
    batch_size: int = 64
    learning_rate: float = 1e-3
    patience: int = 10
    held_out_every: int = 4
    kl_epochs: int = 10
    kl_weight: float = 0.1
    off_data_weight: float = 0.1
    warm_start: bool = False

    @property
    def method(self) -> Method:
        """Which uncertainty h is given."""
        return Method(self.uncertainty, self.members, self.passes)

    def __post_init__(self) -> None:
        _ = self.method  # refuses what is impossible
        if self.pairs not in PAIRS:
            raise OptionError(f"fit pairs is {self.pairs!r}; allowed: {', '.join(PAIRS)}")
        for name, least in (("epochs", 1), ("batch_size", 1), ("patience", 1), ("kl_epochs", 0)):
            if getattr(self, name) < least:
                raise OptionError(f"fit {name} is {getattr(self, name)}; allowed: >= {least}")
        if self.held_out_every < 2:
            raise OptionError(f"fit held_out_every is {self.held_out_every}; allowed: >= 2")
        if not 0 < self.learning_rate < math.inf:
            raise OptionError(f"fit learning_rate is {self.learning_rate}; allowed: > 0, finite")
        for name in ("kl_weight", "off_data_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise OptionError(f"fit {name} is {getattr(self, name)}; allowed: >= 0, finite")
