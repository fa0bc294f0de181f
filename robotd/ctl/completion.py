"""`robotctl completion`: scripts that complete the commands and their options in bash, zsh and fish."""

from __future__ import annotations

from .errors import DONE
from .main import COMMANDS, GROUPS

TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import Namespace

COMMON = ("-H", "--host", "--socket", "--json", "--help")


def completion(arguments: Namespace) -> int:
    """Print the script for one shell."""
    print({"bash": bash, "zsh": zsh, "fish": fish}[arguments.shell](), end="")
    return DONE


def _shown() -> dict[str, str]:
    return {name: text for name, (text, _, _) in COMMANDS.items() if text}


def _words(name: str) -> list[str]:
    """Options of a command, and the values that it allows."""
    words = []
    for flags, settings in COMMANDS[name][2]:
        words += [flag for flag in flags if flag.startswith("-")]
        words += list(settings.get("choices", ())) if not flags[0].startswith("-") else []
    return words


def _first() -> dict[str, str]:
    return {**{name: text for name, text in _shown().items() if " " not in name}, **GROUPS}


def bash() -> str:
    """For bash: source <(robotctl completion bash)."""
    cases = []
    for group in GROUPS:
        seconds = [name.split()[1] for name in _shown() if name.startswith(f"{group} ")]
        cases.append(f'        "{group}") words="{" ".join(seconds)}" ;;')
    for name in _shown():
        cases.append(f'        "{name}") words="{" ".join([*_words(name), *COMMON])}" ;;')
    table = "\n".join(cases)
    first = " ".join([*_first(), *COMMON])
    return f"""\
# bash completion of robotctl: source <(robotctl completion bash)
_robotctl() {{
    local current="${{COMP_WORDS[COMP_CWORD]}}" command="" word skip="" words
    for word in "${{COMP_WORDS[@]:1:$((COMP_CWORD-1))}}"; do
        if [ -n "$skip" ]; then skip=""; continue; fi
        case "$word" in
        -H|--host|--socket) skip=1 ;;
        -*) ;;
        *) case "$command" in
            ""|{"|".join(GROUPS)}) command="${{command:+$command }}$word" ;;
            esac ;;
        esac
    done
    case "$command" in
        "") words="{first}" ;;
{table}
        *) words="" ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _robotctl robotctl
"""


def zsh() -> str:
    """For zsh: its own bash completion runs the same script."""
    return f"""\
# zsh completion of robotctl: source <(robotctl completion zsh)
autoload -U +X compinit && compinit -u
autoload -U +X bashcompinit && bashcompinit
{bash()}"""


def fish() -> str:
    """For fish: robotctl completion fish | source."""
    lines = ["# fish completion of robotctl: robotctl completion fish | source", "complete -c robotctl -f"]
    groups = " ".join(_first())
    lines += [
        "complete -c robotctl -s H -l host -x -d 'ssh://user@host[:port]'",
        "complete -c robotctl -l socket -r -d 'of robotd here'",
        "complete -c robotctl -l json -d 'JSON, for scripts'",
    ]
    for name, text in _first().items():
        lines.append(
            f"complete -c robotctl -n 'not __fish_seen_subcommand_from {groups}' -a {name} -d '{_quoted(text)}'"
        )
    for name, text in _shown().items():
        first, _, second = name.partition(" ")
        if second:
            seconds = " ".join(other.split()[1] for other in _shown() if other.startswith(f"{first} "))
            when = f"__fish_seen_subcommand_from {first}; and not __fish_seen_subcommand_from {seconds}"
            lines.append(f"complete -c robotctl -n '{when}' -a {second} -d '{_quoted(text)}'")
        when = f"__fish_seen_subcommand_from {first}" + (
            f"; and __fish_seen_subcommand_from {second}" if second else ""
        )
        for word in _words(name):
            kind = (
                f"-l {word[2:]}"
                if word.startswith("--")
                else f"-s {word[1:]}"
                if word.startswith("-")
                else f"-a {word}"
            )
            lines.append(f"complete -c robotctl -n '{when}' {kind}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace("'", "\\'")
