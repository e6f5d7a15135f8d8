"""Chance is an argument: names and numbers in, one independent random generator out."""

from zlib import crc32

import numpy as np


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """A generator that depends on the seed and the names alone, never on order, worker or process."""
    words = [seed, *(crc32(n.encode()) if isinstance(n, str) else n for n in names)]
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))


def pair_seed(seed: int, sequence: str, frame0: int, variant: int) -> int:
    """The seed (63 bits, fits the contract's int64) of one pair."""
    return int(generator(seed, sequence, frame0, variant).integers(0, 2**63 - 1))
