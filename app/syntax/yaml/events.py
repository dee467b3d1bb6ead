"""The reference way of reading: any YAML that we take, from libyaml's events."""

from __future__ import annotations

from typing import Any

import yaml

from app.errors import TooLarge
from app.limits import Limits
from app.syntax.yaml.scalars import TAG, UNFOLD_FREE, UNFOLD_TIMES, PlainScalar, Tagged, scalar, yaml_error


def _tagged_scalar(tag: str, text: str) -> Any:
    """The value of a scalar with an explicit tag."""
    if tag in (TAG + "str", "!"):
        return text
    value = scalar(text)
    kind: dict[str, Any] = {"int": int, "float": (int, float), "bool": bool, "null": type(None)}
    expected_type = kind.get(tag.removeprefix(TAG)) if tag.startswith(TAG) else None
    if expected_type is None:
        raise ValueError(f"the tag {tag[:80]} is not supported")
    if not isinstance(value, expected_type) or (isinstance(value, bool) and expected_type is not bool):
        raise ValueError(f"{text[:80]!r} does not fit its tag {tag}")
    return float(value) if tag == TAG + "float" else value


def load_events(text: str, limits: Limits, tags: tuple[str, ...] = (), *, typed: bool = True) -> Any:
    """The reference: builds the value from libyaml's event stream, without recursion."""
    loader: Any = yaml.CSafeLoader(text)
    event: Any = None
    budget = UNFOLD_FREE + UNFOLD_TIMES * len(text)
    root: list[Any] = []
    # Open collections, outermost first: [value, pending key, is a mapping, weight, what its anchor stands for, tag].
    stack: list[list[Any]] = [[root, None, False, 0, None, None]]
    # What each name stands for, (value, weight), empty while its collection is open. The last anchor of a name counts.
    anchors: dict[str, list[tuple[Any, int]]] = {}
    nodes = documents = 0
    try:
        while True:
            event = loader.get_event()
            kind = type(event)
            weight = 0
            anchor_slot: list[tuple[Any, int]] | None = None
            if kind is yaml.ScalarEvent:
                nodes += 1
                if event.anchor is not None:
                    anchor_slot = anchors[event.anchor] = []
                literal: str = event.value
                top = stack[-1]
                as_key = top[2] and top[1] is None
                plain = event.implicit[0]
                if as_key and (event.tag is None or event.tag == "!"):
                    if plain and literal == "<<":
                        raise ValueError("merge keys (<<) are not supported; write the keys out")
                    value: Any = literal
                elif event.tag is not None:
                    value = _tagged_scalar(event.tag, literal)
                elif typed:
                    value = scalar(literal) if plain else literal
                else:
                    value = PlainScalar(literal) if plain else literal
                weight = 8 + len(literal)
            elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
                nodes += 1
                mapping = kind is yaml.MappingStartEvent
                tag = None
                if event.tag not in (None, "!", TAG + ("map" if mapping else "seq")):
                    if not event.tag.startswith(tags):
                        raise ValueError(f"the tag {event.tag[:80]} is not supported")
                    tag = event.tag
                if stack[-1][2] and stack[-1][1] is None:
                    raise ValueError("a key must be a text, not a collection")
                if len(stack) > limits.yaml_depth:
                    raise ValueError(f"nested deeper than {limits.yaml_depth} levels")
                if event.anchor is not None:
                    anchor_slot = anchors[event.anchor] = []
                stack.append([{} if mapping else [], None, mapping, 8, anchor_slot, tag])
                continue
            elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
                value, _, _, weight, anchor_slot, tag = stack.pop()
                if tag is not None:
                    value = Tagged(tag, value)
            elif kind is yaml.AliasEvent:
                if event.anchor not in anchors:
                    raise ValueError(f"the alias *{event.anchor[:80]} has no anchor before it")
                if not anchors[event.anchor]:
                    raise ValueError(f"the alias *{event.anchor[:80]} stands inside its own anchor")
                value, weight = anchors[event.anchor][0]
                nodes += 1
                budget -= weight
                if budget < 0:
                    raise yaml_error(
                        "the aliases unfold to far more than the file holds", event.start_mark.line, TooLarge
                    )
            elif kind is yaml.DocumentStartEvent:
                documents += 1
                if documents > 1:
                    raise ValueError("a second document begins here; only one is read")
                if event.tags and not set(event.tags.values()) <= set(tags):
                    raise ValueError("%TAG directives are not supported" if not tags else "an unknown %TAG directive")
                continue
            elif kind is yaml.StreamEndEvent:
                break
            else:
                continue
            if nodes > limits.yaml_nodes:
                raise yaml_error(f"more than {limits.yaml_nodes} nodes", event.start_mark.line, TooLarge)
            if anchor_slot is not None:
                anchor_slot.append((value, weight))
            top = stack[-1]
            top[3] += weight
            if not top[2]:
                top[0].append(value)
            elif top[1] is None:
                if not isinstance(value, str):
                    raise ValueError("a key must be a text")
                if value in top[0]:
                    raise ValueError(f"the key {value[:80]!r} stands twice in one mapping")
                top[1] = value
            else:
                top[0][top[1]] = value
                top[1] = None
    except ValueError as error:
        raise yaml_error(str(error), event.start_mark.line) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        reason = " ".join(filter(None, [error.context, error.problem])) or "not YAML"
        raise yaml_error(reason, mark.line if mark else None) from error
    except yaml.YAMLError as error:
        raise yaml_error(f"not YAML: {error}", None) from error
    finally:
        loader.dispose()
    return root[0] if root else None
