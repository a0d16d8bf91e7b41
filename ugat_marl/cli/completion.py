"""Scripts that let a shell complete commands, options and their values.

The scripts hold all words, so that a key press starts no program. Print the script
again after an update of the package.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from ugat_marl.cli.help import COMPLETION, DEADLINE, HELP_ALL, is_positional, options_of
from ugat_marl.effects import NAMED_DOMAINS
from ugat_marl.errors import UnknownNameError
from ugat_marl.policies import BASELINES, RULE_NAMES, SUITE_LEARNERS
from ugat_marl.scenarios import shipped_scenarios

SHELLS = {
    "bash": 'eval "$({program} completion bash)"    # in ~/.bashrc',
    "zsh": 'eval "$({program} completion zsh)"     # in ~/.zshrc, after compinit',
    "fish": "{program} completion fish > ~/.config/fish/completions/{program}.fish",
}
"""Shells, and the line that loads their script."""


@dataclass(frozen=True)
class Verb:
    """Words that may follow a command.

    Attributes:
        purpose: One line of help.
        options: Option to its values; empty for a file or a number.
        arguments: Values of the positional arguments.
        flags: Options without a value.
        lists: Options that take several values.
    """

    purpose: str
    options: Mapping[str, tuple[str, ...]]
    arguments: tuple[str, ...]
    flags: tuple[str, ...]
    lists: tuple[str, ...]


def completion_script(
    program: str,
    commands: Mapping[str, tuple[str, str]],
    shell: str,
    short: Mapping[str, tuple[str, ...]],
) -> str:
    """Return the script of a shell.

    Args:
        program: Name of the program.
        commands: Commands as in `CommandLine`.
        shell: "bash", "zsh" or "fish".
        short: Short names of commands, and the words that replace them.

    Raises:
        UnknownNameError: There is no script for the shell.
    """
    if shell not in SHELLS:
        raise UnknownNameError("shell", shell, SHELLS)
    verbs = {name: _verb(place, text) for name, (place, text) in commands.items()}
    for name, words in short.items():
        verbs[name] = verbs[" ".join(word for word in words if not word.startswith("-"))]
    verbs[COMPLETION] = Verb("print the completion script of a shell", {}, (*SHELLS,), (), ())
    return _SCRIPTS[shell](program, verbs)


def _verb(place: str, purpose: str) -> Verb:
    """Return the words of one command; its module is imported."""
    module, _, attribute = place.partition(":")
    command = getattr(importlib.import_module(module), attribute)
    known = _known_values()
    options: dict[str, tuple[str, ...]] = {}
    arguments: tuple[str, ...] = ()
    flags, lists = ["--help", "--quiet", "--verbose"], list[str]()
    flags += [HELP_ALL] * bool(getattr(command, "FIRST", ()))
    for option, hint in options_of(command).items():
        extras = getattr(hint, "__metadata__", ())
        metavars = {getattr(extra, "metavar", None) for extra in extras}
        if "SCENARIO" in metavars:
            arguments = known["--scenario"]
        elif not is_positional(hint):
            options[option] = known.get(option, _choices(hint))
        if hint is bool:
            *path, last = option.removeprefix("--").split(".")
            flags += [option, "--" + ".".join([*path, f"no-{last}"])]
        elif _takes_several(hint):
            lists.append(option)
    options |= dict.fromkeys([*flags, DEADLINE], ())
    return Verb(purpose, options, arguments, tuple(flags), tuple(lists))


def _known_values() -> dict[str, tuple[str, ...]]:
    """Return the values of options that take names of the suite."""
    domains = ("sim", *NAMED_DOMAINS)
    return {
        "--scenario": tuple(name for name, _ in shipped_scenarios()),
        "--real": domains,
        "--domain": domains,
        "--domains": domains,
        "--learner": (*SUITE_LEARNERS, *BASELINES),
        "--policies": RULE_NAMES,
        "--policy": RULE_NAMES,
        "--rules": RULE_NAMES,
    }


def _choices(hint: Any) -> tuple[str, ...]:
    """Return the words that a type allows; empty if there are no such words."""
    if get_origin(hint) is Literal:
        return tuple(map(str, get_args(hint)))
    inner = getattr(hint, "__origin__", None)
    parts = get_args(hint) if get_origin(hint) is not None else ()
    if getattr(hint, "__metadata__", ()):
        parts = (inner,)
    return tuple(word for part in parts if part is not hint for word in _choices(part))


def _takes_several(hint: Any) -> bool:
    """Return True if a type is a tuple, or may be one."""
    parts = get_args(hint) if get_origin(hint) is not Literal else ()
    return get_origin(hint) is tuple or any(map(_takes_several, parts))


def _groups(verbs: Mapping[str, Verb]) -> dict[str, list[str]]:
    """Return the members of commands of two words by their first."""
    groups: dict[str, list[str]] = {}
    for name in verbs:
        first, _, second = name.partition(" ")
        groups.setdefault(first, [])
        if second:
            groups[first].append(second)
    return groups


def _bash(program: str, verbs: Mapping[str, Verb]) -> str:
    function = "_" + program.replace("-", "_")
    groups = _groups(verbs)
    two = "|".join(name for name, members in groups.items() if members)
    flags = "|".join(_place(name, x) for name, verb in verbs.items() for x in verb.flags)
    lists = "|".join(_place(name, x) for name, verb in verbs.items() for x in verb.lists)
    lines = [
        f"{function}() {{",
        '    local current="${COMP_WORDS[COMP_CWORD]}" verb="${COMP_WORDS[1]}" last="" words="" i',
        f'    case "$verb" in {two}) verb="$verb ${{COMP_WORDS[2]}}" ;; esac',
        "    # last: the option to which the current word belongs",
        "    for ((i = 2; i < COMP_CWORD; i++)); do",
        '        case "${COMP_WORDS[i]}" in',
        '            --*) last="${COMP_WORDS[i]}"',
        f'                case "$verb,$last" in {flags}) last="" ;; esac ;;',
        f'            *) case "$verb,$last" in {lists}) ;; *) last="" ;; esac ;;',
        "        esac",
        "    done",
        '    case "$COMP_CWORD,$verb" in',
        f'        1,*) words="{" ".join(groups)}" ;;',
    ]
    lines += [
        f'        2,{name}\\ *) words="{" ".join(members)}" ;;'
        for name, members in groups.items()
        if members
    ]
    lines += ['        *) case "$verb,$last,$current" in']
    for name, verb in verbs.items():
        lines.append(f'            {_place(name, "*")},-*) words="{" ".join(verb.options)}" ;;')
        lines += [
            f'            {_place(name, option)},*) words="{" ".join(values)}" ;;'
            for option, values in verb.options.items()
            if values
        ]
        if verb.arguments:
            lines.append(f'            {_place(name, "")},*) words="{" ".join(verb.arguments)}" ;;')
    lines += [
        "        esac ;;",
        "    esac",
        '    COMPREPLY=($(compgen -W "$words" -- "$current"))',
        "}",
        f"complete -o default -F {function} {program}",
    ]
    return "\n".join(lines) + "\n"


def _place(verb: str, option: str) -> str:
    """Return the pattern of a word after an option of a command."""
    return f"{verb},{option}".replace(" ", "\\ ")


def _zsh(program: str, verbs: Mapping[str, Verb]) -> str:
    return "autoload -U +X bashcompinit && bashcompinit\n" + _bash(program, verbs)


def _fish(program: str, verbs: Mapping[str, Verb]) -> str:
    lines: list[str] = []
    groups = _groups(verbs)
    for first, members in groups.items():
        purpose = ", ".join(members) or verbs[first].purpose
        lines.append(
            f"complete -c {program} -n __fish_use_subcommand -f -a {first} -d {_quoted(purpose)}"
        )
        for member in members:
            seen = f"__fish_seen_subcommand_from {first}"
            seen += f"; and not __fish_seen_subcommand_from {' '.join(members)}"
            text = _quoted(verbs[f"{first} {member}"].purpose)
            lines.append(f"complete -c {program} -n {_quoted(seen)} -f -a {member} -d {text}")
    for name, verb in verbs.items():
        seen = "; and ".join(f"__fish_seen_subcommand_from {word}" for word in name.split())
        common = f"complete -c {program} -n {_quoted(seen)}"
        if verb.arguments:
            lines.append(f"{common} -a {_quoted(' '.join(verb.arguments))}")
        for option, values in verb.options.items():
            line = f"{common} -l {option.removeprefix('--')}"
            lines.append(f"{line} -x -a {_quoted(' '.join(values))}" if values else line)
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


_SCRIPTS: dict[str, Callable[[str, Mapping[str, Verb]], str]] = {
    "bash": _bash,
    "zsh": _zsh,
    "fish": _fish,
}
