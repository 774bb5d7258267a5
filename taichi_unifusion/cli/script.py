"""For scripts of one's own, as those in apps/: their arguments, and errors as a sentence."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence

from ..errors import InputError, UniFusionError, as_known
from .interrupts import INTERRUPTED
from .terminal import DONE, log_to_stderr, logger, report


def run_script(main: Callable[..., object], argv: Sequence[str] | None = None) -> int:
    """Call a function of words with those of the command line, and return the exit code: 0 done, 2
    wrong arguments or input, each told in a sentence, 130 stopped by Ctrl-C.

        if __name__ == "__main__":
            sys.exit(run_script(main))

    -h and --help print the docstring of the script.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if {"-h", "--help"} & set(words):
        print(inspect.cleandoc(main.__globals__.get("__doc__") or usage_of(main)))
        return DONE
    with log_to_stderr():
        try:
            check_words(main, words)
            main(*words)
        except KeyboardInterrupt:
            logger.error("stopped")
            return INTERRUPTED
        except UniFusionError as error:
            return report([error])
        except (MemoryError, RuntimeError) as error:
            if (known := as_known(error)) is error:
                raise
            return report([known])
    return DONE


def check_words(main: Callable[..., object], words: Sequence[str]) -> None:
    """Raise InputError where a function does not take so many words."""
    try:
        inspect.signature(main).bind(*words)
    except TypeError:
        wrong = f"{len(words)} arguments" if len(words) != 1 else "1 argument"
        raise InputError(f"wrong arguments: expected {usage_of(main)}, got {wrong}") from None


def usage_of(main: Callable[..., object]) -> str:
    """A function's parameters as a usage line writes them: FORMAT PATH [NETWORK] [TEXT ...]."""
    words = []
    for name, parameter in inspect.signature(main).parameters.items():
        word = (
            name.rstrip("s").upper() + " ..."
            if parameter.kind is parameter.VAR_POSITIONAL
            else name.upper()
        )
        optional = (
            parameter.kind is parameter.VAR_POSITIONAL or parameter.default is not parameter.empty
        )
        words.append(f"[{word}]" if optional else word)
    return " ".join(words)
