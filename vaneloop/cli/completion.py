"""``vaneloop completion``: a script that lets a shell complete commands, options and their words."""

from __future__ import annotations

import argparse
import importlib
import re
import shlex

from vaneloop.base import terminal
from vaneloop.base.errors import InputError, meant

__all__ = ["DESCRIPTION", "SHELLS", "add_options", "command"]

SHELLS = ("bash", "zsh", "fish")
DESCRIPTION = """Print a script that completes the commands of vaneloop, their options, and the words that an option
takes. Everything else completes as a file.

examples:
  vaneloop completion bash
  vaneloop completion zsh
  vaneloop completion fish

to keep it:
  bash: vaneloop completion bash > ~/.local/share/bash-completion/completions/vaneloop
  zsh:  vaneloop completion zsh > "${fpath[1]}/_vaneloop"
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


def _options() -> dict[str, list[argparse.Action]]:
    """The options of every command."""
    from vaneloop.cli.main import COMMANDS

    out = {}
    for name, (module, _) in COMMANDS.items():
        try:
            loaded = importlib.import_module(module)
        except ImportError:  # the workbench, where its packages are not installed
            out[name] = list[argparse.Action]()
            continue
        parser = terminal.Parser(prog=name)
        loaded.add_options(parser)
        out[name] = list(parser._actions)
    return out


def _choices(action: argparse.Action) -> list[str]:
    return [str(c) for c in action.choices or ()]


def _about() -> dict[str, str]:
    from vaneloop.cli.main import COMMANDS

    return {name: text for name, (_, text) in COMMANDS.items()}


def _help(action: argparse.Action) -> str:
    """The first words of an option's help."""
    text = (action.help or "").replace("%%", "%").replace("%(default)s", str(action.default))
    return re.split(r"[;(\n]", text)[0].strip()


def _bash() -> str:
    options = _options()
    lines, words = [], []
    for name, actions in options.items():
        flags = " ".join(f for a in actions for f in a.option_strings)
        lines.append(f'        {name}) words="{flags}" ;;')
        for a in actions:
            if _choices(a):
                at = "|".join(f'"{name} {f}"' for f in a.option_strings) or f'"{name} {name}"'
                words.append(f'        {at}) COMPREPLY=($(compgen -W "{" ".join(_choices(a))}" -- "$cur")); return ;;')
    shells = f'        "completion completion") COMPREPLY=($(compgen -W "{" ".join(SHELLS)}" -- "$cur")); return ;;'
    return "\n".join([
        "_vaneloop() {",
        '    local cur="${COMP_WORDS[COMP_CWORD]}" prev="${COMP_WORDS[COMP_CWORD-1]}" name="${COMP_WORDS[1]}" words=""',
        "    COMPREPLY=()",
        '    if [ "$COMP_CWORD" -eq 1 ]; then',
        f'        COMPREPLY=($(compgen -W "{" ".join(options)} --help --version" -- "$cur")); return',
        "    fi",
        '    case "$name $prev" in', *words, shells, "    esac",
        '    case "$name" in', *lines, "    esac",
        '    if [[ "$cur" == -* ]]; then COMPREPLY=($(compgen -W "$words" -- "$cur"))',
        '    else COMPREPLY=($(compgen -f -- "$cur")); fi',
        "}",
        "complete -o filenames -F _vaneloop vaneloop",
    ])  # fmt: skip


def _zsh() -> str:
    def spec(word: str, text: str) -> str:
        return shlex.quote(f"{word}:{text}")

    lines, words = [], []
    for name, actions in _options().items():
        flags = " ".join(spec(f, _help(a)) for a in actions for f in a.option_strings)
        lines.append(f"        {name}) options=({flags}) ;;")
        for a in actions:
            if _choices(a) and a.option_strings:
                at = "|".join(f'"{name} {f}"' for f in a.option_strings)
                words.append(f"        {at}) compadd -- {shlex.join(_choices(a))}; return ;;")
    return "\n".join([
        "#compdef vaneloop",
        "_vaneloop() {",
        "    local -a commands options",
        "    if (( CURRENT == 2 )); then",
        f"        commands=({' '.join(spec(n, t) for n, t in _about().items())})",
        "        _describe command commands; return",
        "    fi",
        '    case "$words[2] $words[CURRENT-1]" in', *words,
        f'        "completion completion") compadd -- {" ".join(SHELLS)}; return ;;', "    esac",
        '    case "$words[2]" in', *lines, "    esac",
        '    if [[ "$PREFIX" == -* ]]; then _describe option options; else _files; fi',
        "}",
        "compdef _vaneloop vaneloop",
    ])  # fmt: skip


def _fish() -> str:
    def quoted(text: str) -> str:
        return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"

    out = [f"complete -c vaneloop -f -n __fish_use_subcommand -a {n} -d {quoted(t)}" for n, t in _about().items()]
    for name, actions in _options().items():
        seen = f"-n '__fish_seen_subcommand_from {name}'"
        for a in actions:
            long = " ".join(f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in a.option_strings)
            takes = "" if a.nargs == 0 else f" -x -a {quoted(' '.join(_choices(a)))}" if _choices(a) else " -r"
            if long:
                out.append(f"complete -c vaneloop {seen} {long}{takes} -d {quoted(_help(a))}")
    out.append(f"complete -c vaneloop -f -n '__fish_seen_subcommand_from completion' -a '{' '.join(SHELLS)}'")
    return "\n".join(out)
