"""Code words that are fixed before anything is seen: Reed-Solomon over durations, constant weight over on and off.

Reed-Solomon words are maximum distance separable: with k digits of information (q^k >= number of labels) and c check
digits any two labels differ in c + 1 slots or more. With one duration only, a label flashes in some slots and stays
dark in the others; all words have the same weight, so "never seen" is no word and every label is seen equally often.

Reed and Solomon, Polynomial Codes over Certain Finite Fields, J. SIAM 8 (1960); one digit for infinity makes the
extended code, of length q + 1. Thesis section 8.4.1 proposes the plain binary number, which one miss turns into another
label's.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

Digits = NDArray[np.int64]

WEIGHT = 0.45  # of a constant-weight word


def code_words(number: int, symbols: int, check_digits: int, extra: int = 0) -> tuple[Digits, int]:
    """Reed-Solomon code words for so many labels, those with the shortest durations first.

    Parameters
    ----------
    number : int
        Labels.
    symbols : int
        Prime size q of the alphabet.
    check_digits, extra : int
        Digits beyond those of information, and further columns for repeated slots.

    Returns
    -------
    words : (number, length) array
        Digits 0..q-1. Any two rows agree in fewer than k columns, over any choice of up to q + 1 columns.
    planned : int
        Columns to be sent; the rest is `extra`, as far as the code allows.
    """
    information = 1
    while symbols**information < number:
        information += 1
    planned = min(information + check_digits, max(symbols + 1, information))
    length = max(planned, min(planned + extra, symbols + 1))
    messages = np.arange(symbols**information)[:, None] // symbols ** np.arange(information)[None, :] % symbols
    if length > symbols + 1:  # more information than the alphabet can protect: the plain number
        return messages[:number], information
    columns = []
    for point in range(min(length, symbols)):
        value = np.zeros(len(messages), np.int64)
        for digit in messages.T[::-1]:
            value = (value * point + digit) % symbols
        columns.append(value)
    if length == symbols + 1:
        columns.append(messages[:, -1])
    words = np.stack(columns, axis=1)
    sent = words[:, :planned]
    order = np.lexsort((sent.sum(axis=1), sent.max(axis=1)))
    return words[order[:number]], planned


@functools.cache
def on_off_words(number: int, check_digits: int) -> Digits:
    """Words of constant weight for so many labels.

    Parameters
    ----------
    number : int
        Labels.
    check_digits : int
        Slots beyond those that a search among words of that length needs, 1.7 log2(number).

    Returns
    -------
    (number, length) array
        0 where the label flashes, -1 where it stays dark: indices of the only duration. Any two words differ in four
        places or more unless there are too few such words, then in two.
    """
    length = max(2, math.ceil(1.7 * math.log2(max(number, 2))) + check_digits)
    weight = max(1, round(WEIGHT * length))
    while math.comb(length, weight) < number:
        length += 1
        weight = max(1, round(WEIGHT * length))
    rng = np.random.default_rng(0)  # because every start of the robot must find the same words
    words = np.zeros((0, length), np.float32)
    for least in (4, 2):
        for _ in range(12):
            drawn = np.zeros((max(64, 2 * number), length), np.float32)
            np.put_along_axis(drawn, np.argsort(rng.random(drawn.shape), axis=1)[:, :weight], 1.0, axis=1)
            words = _spread(words, drawn, weight - least / 2.0, number)
            if len(words) == number:
                return np.where(words > 0.5, 0, -1).astype(np.int64)
    raise AssertionError("there are enough words of that length and weight, and random draws find them")


def _spread(words: NDArray[np.float32], drawn: NDArray[np.float32], overlap: float, number: int) -> NDArray[np.float32]:
    """Add those drawn words that share at most `overlap` slots with every other one, until there are enough."""
    for start in range(0, len(drawn), 64):
        block = drawn[start : start + 64]
        block = block[(block @ words.T <= overlap).all(axis=1)]
        common = np.tril(block @ block.T, -1) > overlap
        block = block[~common.any(axis=1)]
        words = np.concatenate([words, block])[:number]
        if len(words) == number:
            break
    return words


def largest_prime(number: int) -> int:
    """The largest prime up to `number`, which is at least 2."""
    return next(n for n in range(number, 1, -1) if all(n % k for k in range(2, math.isqrt(n) + 1)))
