"""``vaneloop completion``: a script that lets a shell complete commands, options and their words."""

from __future__ import annotations

import argparse
import importlib
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import hil.inject
from controller import STRATEGIES
from hil.logs.formats import suffixes
from hil.loop.ecu import BUILTIN
from plant.effects import EFFECTS
from vaneloop.base import terminal
from vaneloop.base.errors import InputError, meant
from vaneloop.cli.main import COMMANDS
from vaneloop.design.links import CRITERIA

__all__ = ["DESCRIPTION", "SHELLS", "add_options", "command"]

SHELLS = ("bash", "zsh", "fish")
DESCRIPTION = """Print a script that completes the commands of vaneloop, their options, the words that an option takes,
and logs by their suffixes, those of installed packages too. Everything else completes as a file.

examples:
  vaneloop completion bash
  vaneloop completion zsh
  vaneloop completion fish

to keep it (make the folder where there is none):
  bash: vaneloop completion bash > ~/.local/share/bash-completion/completions/vaneloop
  zsh:  vaneloop completion zsh > ~/.zfunc/_vaneloop, and in ~/.zshrc, once:
        fpath=(~/.zfunc $fpath); autoload -Uz compinit; compinit
  fish: vaneloop completion fish > ~/.config/fish/completions/vaneloop.fish

exit codes: 0 printed, 2 bad input"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shell", metavar="SHELL", help="bash, zsh or fish")


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    if args.shell not in SHELLS:
        raise InputError(f"{args.shell!r} is not a shell{meant(args.shell, SHELLS)}; allowed: {', '.join(SHELLS)}")
    print({"bash": _bash, "zsh": _zsh, "fish": _fish}[args.shell]())
    return 0


@dataclass(frozen=True)
class _Taken:
    """An option or a place of a command.

    flags   of an option; empty for a place
    words   what it takes; ``only`` these, or files as well
    logs    its files are logs
    value   whether it takes anything
    """

    flags: tuple[str, ...]
    words: tuple[str, ...]
    only: bool
    value: bool
    about: str
    logs: bool = False


def _known() -> dict[str, tuple[str, ...]]:
    """Words that options and places take beside files, where the parser does not list them."""
    profiles = (*BUILTIN, "engine-test")
    scenarios = (Path(hil.inject.__file__).parent / "scenarios").glob("*.toml")
    return {
        "--bus": ("lockstep", "local", "vcan0"), "ecu --profile": profiles, "run --profile": profiles,
        "--strategy": tuple(STRATEGIES), "--effect": tuple(EFFECTS), "--without": tuple(EFFECTS),
        "--criterion": CRITERIA, "--on": ("local", "slurm"),
        "--plant": ("plant_electromechanical.toml", "plant_two_actuators.toml"),
        "inject scenario": tuple(sorted(f.stem for f in scenarios)), "completion shell": SHELLS,
    }  # fmt: skip


_LOGS = ("log", "logs", "--log", "--also")
_ALONE = ("--strategy", "--criterion", "--on", "--without", "shell")  # no file is one of these


def _commands() -> dict[str, list[_Taken]]:
    """What every command takes, and every part of a command (fleet run)."""
    known = _known()

    def taken(name: str, parser: argparse.ArgumentParser) -> Iterator[tuple[str, list[_Taken]]]:
        out: list[_Taken] = []
        yield name, out
        for a in parser._actions:
            what = a.option_strings[-1] if a.option_strings else a.dest
            words = tuple(map(str, a.choices or ())) or known.get(f"{name} {what}", known.get(what, ()))
            only = bool(a.choices) or what in _ALONE
            out.append(_Taken(tuple(a.option_strings), words, only, a.nargs != 0, _help(a), what in _LOGS))
            if isinstance(a, argparse._SubParsersAction):
                for part, its in a.choices.items():
                    yield from taken(f"{name} {part}", its)

    found: dict[str, list[_Taken]] = {}
    for name, (module, _) in COMMANDS.items():
        try:
            loaded = importlib.import_module(module)
        except ImportError:  # the workbench, where its packages are not installed
            found[name] = []
            continue
        parser = terminal.Parser(prog=name)
        loaded.add_options(parser)
        found.update(taken(name, parser))
    return found


def _about() -> dict[str, str]:
    return {name: text for name, (_, text) in COMMANDS.items()}


def _help(action: argparse.Action) -> str:
    """The first words of an option's help."""
    text = (action.help or "").replace("%%", "%").replace("%(default)s", str(action.default))
    return re.split(r"[;(\n]", text)[0].strip()


def _parts(commands: dict[str, list[_Taken]]) -> str:
    """A shell pattern of all commands of two words."""
    return "|".join(f'"{name}"' for name in commands if " " in name)


def _place(taken: list[_Taken]) -> tuple[tuple[str, ...], str]:
    """Words that stand at a command's place beside files, and what a shell is told where no file does, or a log."""
    place = next((a for a in taken if not a.flags and (a.words or a.logs)), None)
    return (place.words, " files=" if place.only else " files=logs" if place.logs else "") if place else ((), "")


def _endings(between: str) -> str:
    """The suffixes of logs without their points."""
    return between.join(s.removeprefix(".") for s in suffixes())


def _with_words(commands: dict[str, list[_Taken]]) -> Iterator[tuple[str, _Taken]]:
    """Every option that has words or takes a log, with a shell's pattern of its command and its names."""
    for name, taken in commands.items():
        for a in taken:
            if (a.words or a.logs) and a.flags:
                yield "|".join(f'"{name} {f}"' for f in a.flags), a


def _bash() -> str:
    commands = _commands()
    lines, words = [], []
    for name, taken in commands.items():
        flags = " ".join(f for a in taken for f in a.flags)
        own, files = _place(taken)
        place = f' place="{" ".join(own)}"' if own else ""
        lines.append(f'        "{name}") words="{flags}"{place}{files} ;;')
    for at, a in _with_words(commands):
        if a.logs:
            words.append(f"        {at}) _vaneloop_logs; return ;;")
            continue
        more = "" if a.only else ' $(compgen -f -- "$cur")'
        offered = f'$(compgen -W "{" ".join(a.words)}" -- "$cur")'
        words.append(f"        {at}) COMPREPLY=({offered}{more}); return ;;")
    return "\n".join([
        "_vaneloop_logs() {",  # folders and logs; where there are none, any file
        "    local file files",
        '    mapfile -t files < <(compgen -f -- "$cur")',
        '    for file in "${files[@]}"; do case "${file,,}" in',
        f'        *.{_endings("|*.")}) COMPREPLY+=("$file") ;;',
        '        *) if [ -d "$file" ]; then COMPREPLY+=("$file"); fi ;;', "    esac; done",
        '    if [ "${#COMPREPLY[@]}" -eq 0 ]; then COMPREPLY=("${files[@]}"); fi',
        "}",
        "_vaneloop() {",
        '    local cur="${COMP_WORDS[COMP_CWORD]}" prev="${COMP_WORDS[COMP_CWORD-1]}" name="${COMP_WORDS[1]}"',
        '    local words="" place="" files=yes',
        "    COMPREPLY=()",
        '    if [ "$COMP_CWORD" -eq 1 ]; then',
        f'        COMPREPLY=($(compgen -W "{" ".join(_about())} --help --version" -- "$cur")); return',
        "    fi",
        f'    case "$name ${{COMP_WORDS[2]}}" in {_parts(commands)})',
        '        if [ "$COMP_CWORD" -gt 2 ]; then name="$name ${COMP_WORDS[2]}"; fi ;;', "    esac",
        '    case "$name $prev" in', *words, "    esac",
        '    case "$name" in', *lines, "    esac",
        '    if [[ "$cur" == -* ]]; then COMPREPLY=($(compgen -W "$words" -- "$cur"))',
        '    elif [ "$files" = logs ]; then _vaneloop_logs',
        '    else COMPREPLY=($(compgen -W "$place" -- "$cur") ${files:+$(compgen -f -- "$cur")}); fi',
        "}",
        "complete -o filenames -F _vaneloop vaneloop",
    ])  # fmt: skip


def _zsh() -> str:
    def spec(word: str, text: str) -> str:
        return shlex.quote(f"{word}:{text}")

    commands = _commands()
    lines, words = [], []
    for name, taken in commands.items():
        flags = " ".join(spec(f, a.about) for a in taken for f in a.flags)
        own, files = _place(taken)
        place = f" place=({shlex.join(own)})" if own else ""
        lines.append(f'        "{name}") options=({flags}){place}{files} ;;')
    logs = f"_files -g '*.(#i)({_endings('|')})'"  # where there are none, any file
    for at, a in _with_words(commands):
        if a.logs:
            words.append(f"        {at}) {logs}; return ;;")
            continue
        more = "" if a.only else " _files;"
        words.append(f"        {at}) compadd -- {shlex.join(a.words)};{more} return ;;")
    return "\n".join([
        "#compdef vaneloop",
        "_vaneloop() {",
        '    local -a commands options place; local name="$words[2]" files=yes',
        "    if (( CURRENT == 2 )); then",
        f"        commands=({' '.join(spec(n, t) for n, t in _about().items())})",
        "        _describe command commands; return",
        "    fi",
        f'    case "$words[2] $words[3]" in {_parts(commands)})',
        '        if (( CURRENT > 3 )); then name="$words[2] $words[3]"; fi ;;', "    esac",
        '    case "$name $words[CURRENT-1]" in', *words, "    esac",
        '    case "$name" in', *lines, "    esac",
        '    if [[ "$PREFIX" == -* ]]; then _describe option options; return; fi',
        "    compadd -a place",
        f'    if [[ "$files" == logs ]]; then {logs}; elif [[ -n "$files" ]]; then _files; fi',
        "}",
        # a file of fpath is the function itself when it is first called
        'if [[ "$funcstack[1]" == _vaneloop ]]; then _vaneloop "$@"; else compdef _vaneloop vaneloop; fi',
    ])  # fmt: skip


def _fish() -> str:
    def quoted(text: str) -> str:
        return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"

    commands = _commands()
    out = [
        "function __vaneloop_is", "    set -l words (commandline -opc)",
        '    string match -q -- "$argv *" "$words[2..-1] "', "end",
        "function __vaneloop_logs",  # folders and logs; where there are none, any file
        '    set -l files (complete -C "__fish_command_without_completions "(commandline -ct))',
        f"    string match -ri '^.*(?:\\.(?:{_endings('|')})|/)$' -- $files; or string join \\n -- $files", "end",
        "complete -c vaneloop -n __fish_use_subcommand -l help",
        "complete -c vaneloop -n __fish_use_subcommand -l version",
    ]  # fmt: skip
    out += [f"complete -c vaneloop -f -n __fish_use_subcommand -a {n} -d {quoted(t)}" for n, t in _about().items()]
    logs = quoted("(__vaneloop_logs)")
    for name, all_taken in commands.items():
        seen = f"__vaneloop_is {name}"
        for a in all_taken:
            long = " ".join(f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in a.flags)
            takes = (" -x" if a.only else " -r -F") + f" -a {quoted(' '.join(a.words))}" if a.words else " -r"
            takes = f" -x -k -a {logs}" if a.logs else takes
            if long:
                out.append(
                    f"complete -c vaneloop -n {quoted(seen)} {long}{takes if a.value else ''} -d {quoted(a.about)}"
                )
            elif a.logs:
                out.append(f"complete -c vaneloop -f -k -n {quoted(seen)} -a {logs}")
            elif a.words:
                first = f"{seen}; and test (count (commandline -opc)) -eq {1 + len(name.split())}" if a.only else seen
                files = "-f" if a.only else "-F"
                out.append(f"complete -c vaneloop {files} -n {quoted(first)} -a {quoted(' '.join(a.words))}")
    return "\n".join(out)
