"""Errors of the command line are one line."""

import pytest

from train.engine.parser import in_one_line


@pytest.mark.parametrize(
    "message, line",
    [
        ("unrecognized arguments: --a", "unrecognized arguments: --a"),
        ('Parser key "model.clip":\n  Expected a <class \'float\'>. Got value: abc',
         "model.clip: Expected a float. Got value: abc"),
        ('Parser key "model.loss":\n\n  - Expected a path but 3 either not accessible or invalid\n'
         "  - Does not validate against any of the Union subtypes\n  Subtypes: [<class 'a.Loss'>]\n  Errors:\n"
         "    - Expected a dot import path string: 3\n    - Expected a <class 'NoneType'>\n"
         "  Given value type: <class 'str'>\n  Given value: 3", "model.loss: does not accept the value 3"),
        ('Parser key "data.real":\n  Does not validate against any of the Union subtypes\n  Subtypes: [x]\n  Errors:\n'
         "    - Problem with given class_path 'train.data.real.RealData':\n        Parser key \"hops\":\n"
         "          Expected a <class 'list'>. Got value: abc\n    - Expected a <class 'NoneType'>\n"
         "  Given value type: <class 'jsonargparse._util.NestedArg'>\n  Given value: NestedArg(key='hops', val='abc')",
         "data.real: hops: Expected a list. Got value: abc"),
    ],
)  # fmt: skip
def test_messages_of_several_lines(message, line):
    assert in_one_line(message) == line
