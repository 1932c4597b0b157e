"""Errors that are told to users."""

from limbfit.errors import InputError


def test_an_error_of_the_input_is_one_line_whatever_it_is_told():
    error = InputError("two\nlines", file="a\nfile", place="a\tplace", remedy="one\r\nremedy")
    assert str(error) == "a file: a place: two lines; one remedy"
