"""Names of shell variables that no map may set: the server drops them, and a robot refuses them even if signed."""

from __future__ import annotations

import re

DANGEROUS_VARIABLE = re.compile(
    r"PATH|ENV|IFS|SHELL|SHELLOPTS|CDPATH|HOME|USER|LOGNAME|TMPDIR|EDITOR|VISUAL|PAGER|BROWSER|PS[0-4]|PROMPT_COMMAND"
    r"|(LD|DYLD|BASH|ZSH|GIT|SSH|SUDO|LUA|GCONV|FLEETMAP)_\w*|PYTHON\w*|PERL\w*|RUBY\w*|NODE_(OPTIONS|PATH)"
    r"|(JAVA|JDK|JAVA_TOOL)_(OPTIONS|OPTS|HOME)|BASHOPTS|_JAVA_OPTIONS|CLASSPATH|MALLOC_\w+|GLIBC_\w+|\w*LIBRARY_PATH|\w*PLUGIN_PATH|\w*PREFIX_PATH"
    r"|RMW_IMPLEMENTATION|LOCPATH|NLSPATH|\w*_PRELOAD|\w*_PROXY|\w*_proxy"
)
"""Names of variables that control what a program loads, starts or connects to."""
