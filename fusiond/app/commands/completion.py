"""fusiond completion: prints a script that completes the command line in bash, zsh or fish, from its grammar."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

from fusiond.app.commands import COMMANDS

ABOUT = """\
Print a script with which a shell completes fusiond's commands, options and files when the tab key is pressed. The Debian
package installs these scripts."""
EXAMPLES = """\
examples:
  source <(fusiond completion bash)                                    in ~/.bashrc
  source <(fusiond completion zsh)                                     in ~/.zshrc, after compinit
  fusiond completion fish > ~/.config/fish/completions/fusiond.fish"""


class Option(NamedTuple):
    """An option of one command."""

    names: tuple[str, ...]
    about: str
    takes_value: bool
    choices: tuple[str, ...]


def fill(parser: argparse.ArgumentParser) -> None:
    """Define the arguments."""
    parser.description, parser.epilog = ABOUT, EXAMPLES
    parser.add_argument("shell", choices=list(SCRIPTS), help="for which shell")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    grammar = {name: list(_options(_command(arguments.grammar(name), name))) for name in COMMANDS}
    print("\n".join(SCRIPTS[arguments.shell](grammar)))


def _command(top: argparse.ArgumentParser, name: str) -> argparse.ArgumentParser:
    (commands,) = (action for action in top._actions if isinstance(action, argparse._SubParsersAction))
    found: argparse.ArgumentParser = commands.choices[name]
    return found


def _options(command: argparse.ArgumentParser) -> Iterator[Option]:
    """The options of a command, and its arguments that have choices (without a name)."""
    for action in command._actions:
        choices = tuple(map(str, action.choices or ()))
        if action.option_strings or choices:
            about = (action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%")
            yield Option(tuple(action.option_strings), about, action.nargs != 0, choices)


Grammar = dict[str, list[Option]]


def _bash(grammar: Grammar) -> Iterator[str]:
    yield "# bash completion of fusiond; made by `fusiond completion bash`"
    yield "_fusiond() {"
    yield '    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" words=""'
    yield '    if [ "$COMP_CWORD" -eq 1 ]; then'
    yield f'        mapfile -t COMPREPLY < <(compgen -W "{" ".join(grammar)} --help --version" -- "$word")'
    yield "        return"
    yield "    fi"
    yield '    case "${COMP_WORDS[1]} $before" in'
    for command, options in grammar.items():
        for option in options:
            for name in option.names or (command,):
                if option.choices:
                    yield f'        "{command} {name}") words="{" ".join(option.choices)}" ;;'
    yield "    esac"
    yield '    if [ -z "$words" ] && [[ "$word" == -* ]]; then'
    yield '        case "${COMP_WORDS[1]}" in'
    for command, options in grammar.items():
        names = " ".join(name for option in options for name in option.names)
        yield f'            {command}) words="{names}" ;;'
    yield "        esac"
    yield "    fi"
    yield '    if [ -n "$words" ]; then'
    yield '        mapfile -t COMPREPLY < <(compgen -W "$words" -- "$word")'
    yield "    else"
    yield '        mapfile -t COMPREPLY < <(compgen -f -- "$word")'
    yield "        compopt -o filenames 2>/dev/null"
    yield "    fi"
    yield "}"
    yield "complete -F _fusiond fusiond"


def _zsh(grammar: Grammar) -> Iterator[str]:
    yield "#compdef fusiond"
    yield "# zsh completion of fusiond; made by `fusiond completion zsh`"
    yield "_fusiond() {"
    yield "    local -a commands"
    yield "    commands=("
    for command in grammar:
        yield f"        {_quoted(f'{command}:{COMMANDS[command]}')}"
    yield "    )"
    yield "    if (( CURRENT == 2 )); then"
    yield "        _describe command commands"
    yield "        return"
    yield "    fi"
    yield "    local command=$words[2]"
    yield "    shift words"
    yield "    (( CURRENT-- ))"
    yield "    case $command in"
    for command, options in grammar.items():
        specs = [_quoted(spec) for option in options for spec in _zsh_specs(option)]
        yield f"        {command}) _arguments {' '.join(specs)} '*:file:_files' ;;"
    yield "    esac"
    yield "}"
    yield "compdef _fusiond fusiond"


def _zsh_specs(option: Option) -> Iterator[str]:
    about = option.about.replace("[", "(").replace("]", ")").replace(":", ";")
    values = f"({' '.join(option.choices)})" if option.choices else "_files"
    if not option.names:
        yield f"1:{about}:{values}"
    for name in option.names:
        yield f"{name}[{about}]" + (f":value:{values}" if option.takes_value else "")


def _fish(grammar: Grammar) -> Iterator[str]:
    yield "# fish completion of fusiond; made by `fusiond completion fish`"
    yield "complete -c fusiond -n __fish_use_subcommand -f -l version -d 'print the version'"
    for command, about in COMMANDS.items():
        yield f"complete -c fusiond -n __fish_use_subcommand -f -a {command} -d {_quoted(about)}"
    for command, options in grammar.items():
        condition = f"-n '__fish_seen_subcommand_from {command}'"
        for option in options:
            names = [f"-l {name[2:]}" if name.startswith("--") else f"-s {name[1:]}" for name in option.names]
            values = f" -x -a '{' '.join(option.choices)}'" if option.choices else " -r -F" if option.takes_value else ""
            yield f"complete -c fusiond {condition} {' '.join(names)}{values} -d {_quoted(option.about)}".replace("  ", " ")


def _quoted(text: str) -> str:
    """A word of zsh or fish, in single quotes: without a quote in it, which the two write differently."""
    return "'" + text.replace("\\", "").replace("'", '"') + "'"


SCRIPTS = {"bash": _bash, "zsh": _zsh, "fish": _fish}
