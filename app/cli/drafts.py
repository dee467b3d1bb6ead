"""``fleetmap draft``: working versions, which edits gather in until they are committed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import options, output, versions
from app.cli.client import Client, quote_path
from app.cli.groups import Commands
from app.errors import NotFound
from app.model.names import did_you_mean

commands = Commands("List, review and commit drafts: edits that gather until they become one version.")

PREFER = ("draft", "head")

DraftName = Annotated[
    str, typer.Argument(metavar="DRAFT", help="Id or name of the draft, see `fleetmap draft list`.", show_default=False)
]


@commands.command("list")
def show_all(
    environment: options.Environment,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the drafts of an environment, last edited first.

    Example: `fleetmap draft list farm`
    """
    with Client(server, token) as client:
        rows = _all(client, environment)
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("draft", "name", "owner", "base", "changed", "changes"),
        ((r["id"], r["name"], _owner(r), _base(r), output.minute(r["changed"]), _changes(r)) for r in rows),
    )


@commands.command("show")
def show(
    environment: options.Environment,
    draft: DraftName,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show a draft: its owner, its base and what it changes.

    Example: `fleetmap draft show farm 'new lanes'`
    """
    with Client(server, token) as client:
        chosen = _find(client, environment, draft)
    if as_json:
        output.show_json(chosen)
        return
    members = ("id", "name", "version", "created", "changed", "expires")
    shown = {name: chosen[name] for name in members}
    output.show_members({**shown, "owner": _owner(chosen), "base": _base(chosen), "changes": _changes(chosen)})


@commands.command("create")
def create(
    environment: options.Environment,
    name: Annotated[str | None, typer.Argument(help="Name of the draft [default: draft 1, draft 2 …].")] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Create a draft with the content of the newest version.

    Example: `fleetmap draft create farm 'new lanes'`
    """
    with Client(server, token) as client:
        created = client.post(quote_path("environments", environment, "drafts"), {"name": name})
    if as_json:
        output.show_json(created)
    else:
        output.print_result(f"{environment}: draft {created['id']} {created['name']!r}, from version {created['base']}")


@commands.command("diff")
def diff(
    environment: options.Environment,
    draft: DraftName,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show what a draft changes: a summary, then each item (+ added, ~ changed, - deleted).

    Example: `fleetmap draft diff farm 'new lanes'`
    """
    with Client(server, token) as client:
        chosen = _find(client, environment, draft)
    versions.diff(environment, str(chosen["base"]), chosen["version"], server, token, as_json)


@commands.command("commit")
def commit(
    environment: options.Environment,
    draft: DraftName,
    message: options.Message = "",
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Make a draft one version, and remove the draft.

    Example: `fleetmap draft commit farm 'new lanes' -m 'lanes of the new shed'`
    """
    with Client(server, token) as client:
        chosen = _find(client, environment, draft)
        version = client.post(f"{_path(environment, chosen)}/commit", {"message": message}, repeat=True)
    if as_json:
        output.show_json(version)
    else:
        output.print_result(f"{environment}: version {version['version']} ({versions.summary(version['changes'])})")


@commands.command("rebase")
def rebase(
    environment: options.Environment,
    draft: DraftName,
    prefer: Annotated[
        str | None,
        typer.Option(
            "--prefer",
            help="Side: draft or head. It wins where both changed the same [default: list these places].",
            autocompletion=lambda: list(PREFER),
        ),
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Put a draft's changes on top of the newest version. Conflicts are listed, and nothing changes.

    Example: `fleetmap draft rebase farm 'new lanes'`
    """
    options.check_choice("--prefer", prefer, PREFER)
    with Client(server, token) as client:
        chosen = _find(client, environment, draft)
        rebased = client.post(f"{_path(environment, chosen)}/rebase", {"prefer": prefer})
    if as_json:
        output.show_json(rebased)
    else:
        output.print_result(f"{environment}: draft {rebased['name']!r} is based on version {rebased['base']}")


@commands.command("delete")
def delete(
    environment: options.Environment,
    draft: DraftName,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Delete a draft with its changes.

    Example: `fleetmap draft delete farm 'new lanes'`
    """
    with Client(server, token) as client:
        chosen = _find(client, environment, draft)
        client.delete(_path(environment, chosen))
    if as_json:
        output.show_json({"id": chosen["id"], "deleted": True})
    else:
        output.print_result(f"deleted draft {chosen['id']} {chosen['name']!r}")


def _all(client: Client, environment: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = client.get(quote_path("environments", environment, "drafts"))
    return rows


def _find(client: Client, environment: str, draft: str) -> dict[str, Any]:
    """Find a draft by id or name; of several with this name one's own. Raises NotFound."""
    rows = _all(client, environment)
    fitting = [row for row in rows if draft.removeprefix("draft:") == row["id"]]
    fitting = fitting or sorted((r for r in rows if r["name"] == draft), key=lambda r: not r["is_owner"])
    if not fitting:
        names = [row["name"] for row in rows]
        available = ", ".join(repr(name) for name in names) or "none"
        detail = f"unknown draft {draft[:80]!r}{did_you_mean(draft, names)}; available: {available}"
        raise NotFound(detail)
    if len(fitting) > 1 and not fitting[0]["is_owner"]:
        raise typer.BadParameter(f"several drafts are named {draft!r}: use an id of `fleetmap draft list`")
    return fitting[0]


def _path(environment: str, draft: Mapping[str, Any]) -> str:
    return quote_path("environments", environment, "drafts", draft["id"])


def _owner(draft: Mapping[str, Any]) -> str:
    return f"{draft['owner']} (you)" if draft["is_owner"] else str(draft["owner"])


def _base(draft: Mapping[str, Any]) -> str:
    return f"{draft['base']} (head: {draft['head']})" if draft["behind"] else str(draft["base"])


def _changes(draft: Mapping[str, Any]) -> str:
    return versions.summary(draft["changes"]) or "none"
