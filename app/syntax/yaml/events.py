"""Reference parser for all supported YAML, based on libyaml's events."""

from __future__ import annotations

from typing import Any

import yaml

from app.errors import TooLarge
from app.limits import Limits
from app.syntax.yaml.scalars import TAG, UNFOLD_FREE, UNFOLD_TIMES, PlainScalar, Tagged, scalar, yaml_error


def _tagged_scalar(tag: str, text: str) -> Any:
    """Return the value of a scalar with an explicit tag."""
    if tag in (TAG + "str", "!"):
        return text
    value = scalar(text)
    kind: dict[str, Any] = {"int": int, "float": (int, float), "bool": bool, "null": type(None)}
    expected_type = kind.get(tag.removeprefix(TAG)) if tag.startswith(TAG) else None
    if expected_type is None:
        raise ValueError(f"unsupported tag {tag[:80]}")
    if not isinstance(value, expected_type) or (isinstance(value, bool) and expected_type is not bool):
        raise ValueError(f"{text[:80]!r} does not fit its tag {tag}")
    return float(value) if tag == TAG + "float" else value


def load_events(text: str, limits: Limits, tags: tuple[str, ...] = (), *, typed: bool = True) -> Any:
    """Build the value from libyaml's event stream, without recursion."""
    loader: Any = yaml.CSafeLoader(text)
    builder = _Builder(text, limits, tags, typed)
    event: Any = None
    try:
        while True:
            event = loader.get_event()
            if type(event) is yaml.StreamEndEvent:
                break
            builder.take(event)
    except ValueError as error:
        raise yaml_error(str(error), event.start_mark.line) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        reason = " ".join(filter(None, [error.context, error.problem])) or "not YAML"
        raise yaml_error(reason, mark.line if mark else None) from error
    except yaml.YAMLError as error:
        raise yaml_error(f"invalid YAML: {error}", None) from error
    finally:
        loader.dispose()
    return builder.root[0] if builder.root else None


class _Builder:
    """Builder of a value from events.

    stack: open collections, outermost first: [value, pending key, is a mapping, weight, entry of its anchor, tag].
    anchors: name -> (value, weight), empty while its collection is open; the last anchor of a name wins. budget:
    characters that aliases may still add.
    """

    __slots__ = ("anchors", "budget", "documents", "limits", "nodes", "root", "stack", "tags", "typed")

    def __init__(self, text: str, limits: Limits, tags: tuple[str, ...], typed: bool) -> None:
        self.limits, self.tags, self.typed = limits, tags, typed
        self.budget = UNFOLD_FREE + UNFOLD_TIMES * len(text)
        self.root: list[Any] = []
        self.stack: list[list[Any]] = [[self.root, None, False, 0, None, None]]
        self.anchors: dict[str, list[tuple[Any, int]]] = {}
        self.nodes = self.documents = 0

    def take(self, event: Any) -> None:
        """Process the next event. Raises ValueError if it cannot be stored, or TooLarge."""
        kind = type(event)
        anchor: list[tuple[Any, int]] | None = None
        if kind is yaml.ScalarEvent:
            self.nodes += 1
            if event.anchor is not None:
                anchor = self.anchors[event.anchor] = []
            value = self._scalar(event)
            weight = 8 + len(event.value)
        elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
            self._open(event, kind is yaml.MappingStartEvent)
            return
        elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
            value, _, _, weight, anchor, tag = self.stack.pop()
            if tag is not None:
                value = Tagged(tag, value)
        elif kind is yaml.AliasEvent:
            value, weight = self._alias(event)
        else:
            if kind is yaml.DocumentStartEvent:
                self._begin_document(event)
            return
        if self.nodes > self.limits.yaml_nodes:
            raise yaml_error(f"more than {self.limits.yaml_nodes} nodes", event.start_mark.line, TooLarge)
        if anchor is not None:
            anchor.append((value, weight))
        self._add(value, weight)

    def _scalar(self, event: Any) -> Any:
        literal: str = event.value
        top = self.stack[-1]
        plain = event.implicit[0]
        if top[2] and top[1] is None and (event.tag is None or event.tag == "!"):
            if plain and literal == "<<":
                raise ValueError("merge keys (<<) are not supported: write the keys out")
            return literal
        if event.tag is not None:
            return _tagged_scalar(event.tag, literal)
        if self.typed:
            return scalar(literal) if plain else literal
        return PlainScalar(literal) if plain else literal

    def _open(self, event: Any, is_mapping: bool) -> None:
        self.nodes += 1
        tag = None
        if event.tag not in (None, "!", TAG + ("map" if is_mapping else "seq")):
            if not event.tag.startswith(self.tags):
                raise ValueError(f"unsupported tag {event.tag[:80]}")
            tag = event.tag
        stack = self.stack
        if stack[-1][2] and stack[-1][1] is None:
            raise ValueError("a key must be a string, not a collection")
        if len(stack) > self.limits.yaml_depth:
            raise ValueError(f"nested deeper than {self.limits.yaml_depth} levels")
        anchor: list[tuple[Any, int]] | None = None
        if event.anchor is not None:
            anchor = self.anchors[event.anchor] = []
        stack.append([{} if is_mapping else [], None, is_mapping, 8, anchor, tag])

    def _alias(self, event: Any) -> tuple[Any, int]:
        if event.anchor not in self.anchors:
            raise ValueError(f"the alias *{event.anchor[:80]} has no anchor before it")
        if not self.anchors[event.anchor]:
            raise ValueError(f"the alias *{event.anchor[:80]} is inside its own anchor")
        value, weight = self.anchors[event.anchor][0]
        self.nodes += 1
        self.budget -= weight
        if self.budget < 0:
            reason = "the aliases expand to far more than the file's content"
            raise yaml_error(reason, event.start_mark.line, TooLarge)
        return value, weight

    def _begin_document(self, event: Any) -> None:
        self.documents += 1
        if self.documents > 1:
            raise ValueError("only one document is supported, a second one begins here")
        if event.tags and not set(event.tags.values()) <= set(self.tags):
            raise ValueError("%TAG directives are not supported" if not self.tags else "an unknown %TAG directive")

    def _add(self, value: Any, weight: int) -> None:
        """Add a value to the innermost open collection, as key if one is due."""
        top = self.stack[-1]
        top[3] += weight
        if not top[2]:
            top[0].append(value)
        elif top[1] is None:
            if not isinstance(value, str):
                raise ValueError("a key must be a string")
            if value in top[0]:
                raise ValueError(f"duplicate key {value[:80]!r} in a mapping")
            top[1] = value
        else:
            top[0][top[1]] = value
            top[1] = None
