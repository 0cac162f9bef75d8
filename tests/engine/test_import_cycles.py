"""Modules of engine and service can be imported, read and tested one after the other: none needs itself."""

from graphlib import TopologicalSorter

import grimp


def test_no_module_imports_itself_through_others():
    """Stricter than the contract ``no-cycles``: it compares siblings, so a package's own ``__init__`` escapes it."""
    graph = grimp.build_graph("engine", "service", cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert len(imports) > 500
    TopologicalSorter(imports).prepare()
