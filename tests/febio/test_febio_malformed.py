"""Inputs that are broken, hostile or beyond limbfit: one line that names the place, and no harm done."""

import re
import tracemalloc

import pytest
from febfiles import FEB, written

from limbfit.errors import ProblemError
from limbfit.febio import read_feb, run_feb

# what is replaced, by what, and what the error says; once each
CASES = {
    "no XML": (FEB, "solid 1", "not well-formed XML"),
    "empty": (FEB, "", "not well-formed XML"),
    "binary": (FEB, "\0\1\2", "not well-formed XML"),
    "cut short": (FEB, FEB[: len(FEB) // 2], "not well-formed XML"),
    "tag not closed": ("</Mesh>", "", "not well-formed XML"),
    "attribute twice": ('name="fat"', 'name="fat" name="fat"', "not well-formed XML"),
    "unknown encoding": ('version="1.0"?', 'version="1.0" encoding="x-none"?', "not well-formed XML"),
    "deep": ("<Boundary>", "<Boundary>" + "<a>" * 200 + "</a>" * 200, "deeper than 40"),
    "no FEBio": (FEB, "<febio_optimize/>", "not an input of FEBio"),
    "old version": ('version="4.0"', 'version="2.5"', "not an input of FEBio 3 or 4"),
    "no version": (' version="4.0"', "", "not an input of FEBio 3 or 4"),
    "no mesh": (re.search("<Mesh>.*</Mesh>", FEB, re.DOTALL)[0], "", "has no <Mesh>"),
    "no control": (re.search("<Control>.*</Control>", FEB)[0], "", "has no <Control>"),
    "no nodes": (re.search("<Nodes.*</Nodes>", FEB, re.DOTALL)[0], "", "has no nodes"),
    "node without id": ('<node id="12">', "<node>", r"<node>: has no attribute 'id'"),
    "node id no number": ('<node id="12">', '<node id="twelve">', "'twelve' is not a whole number"),
    "node id endless": ('<node id="12">', f'<node id="{"9" * 400}">', "is not a whole number"),
    "node twice": ('<node id="12">', '<node id="8">', "node 8 is there twice"),
    "NaN": ("0,0,2</node>", "0,nan,2</node>", r"line 1\d, <node>: '0,nan,2' is not finite"),
    "infinite": ("0,0,2</node>", "0,1e999,2</node>", "is not finite"),
    "two coordinates": ("0,0,2</node>", "0,2</node>", "is not 3 numbers"),
    "words": ("0,0,2</node>", "here</node>", "is not 3 numbers"),
    "element without node": ("8,9,11,12", "8,9,11,13", r"<elem>: there is no node 13"),
    "element too short": ("8,9,11,12", "8,9,11", "element 1 has 3 nodes; tet4 has 4"),
    "element twice": ('<elem id="2">', '<elem id="1">', "element 1 is there twice"),
    "element inverted": ("8,9,11,12", "8,11,9,12", "part 'body' .*first is element 1"),
    "element flat": ("0,0,2</node>", "1,1,0</node>", "inverted or flat"),
    "element type": ('type="tet4"', 'type="wedge99"', "'wedge99' are not supported"),
    "quadrature": ('<SolidDomain name="body"', '<SolidDomain elem_type="TET4G4" name="body"', "TET4G4"),
    "nodal strain": ('<SolidDomain name="body"', '<SolidDomain type="ut4-solid" name="body"', "ut4-solid"),
    "set without node": (">8,9,11</NodeSet>", ">8,9,99</NodeSet>", "<NodeSet>: there is no node 99"),
    "set of words": (">8,9,11</NodeSet>", ">all</NodeSet>", "'all' is no number"),
    "list without part": ("</Mesh>", '<PartList name="l">body,bone</PartList></Mesh>', "no part 'bone'"),
    "set of no elements": ('node_set="ground"', 'node_set="@elem_set:none"', "no node set '@elem_set:none'"),
    "set backwards": (">8,9,11</NodeSet>", ">5:1</NodeSet>", "no items 5 to 1"),
    "set of billions": (">8,9,11</NodeSet>", ">1:9000000000</NodeSet>", "no items 1 to 9000000000"),
    "surface without node": ('<tri3 id="1">9,11,12', '<tri3 id="1">9,11,77', "there is no node 77"),
    "pair without surface": ("<primary>skin", "<primary>sin", "there is no surface 'sin'"),
    "no such material": ('mat="fat"', 'mat="tissue7"', "<SolidDomain>: there is no material 'tissue7'"),
    "no such part": ('SolidDomain name="body"', 'SolidDomain name="bdy"', "'body' has no domain"),
    "material twice": ('id="2" name="steel"', 'id="1" name="steel"', "is there twice"),
    "unknown law": ('type="Ogden"', 'type="Arruda-Boyce"', "material fat: .*Arruda-Boyce"),
    "coupled law": ('type="uncoupled viscoelastic"', 'type="neo-Hookean"', "use 'incomp neo-Hookean'"),
    "modulus missing": ("<k>0.6</k>", "<k>-0.2</k>", "no positive bulk modulus"),
    "modulus negative": ("<c1>0.004</c1>", "<c1>-1</c1>", "not positive"),
    "modulus NaN": ("<c1>0.004</c1>", "<c1>nan</c1>", "not finite"),
    "relaxation time zero": ("<t1>0.5</t1>", "<t1>0</t1>", "material fat: .*tau = 0"),
    "parameter over time": ("<c1>0.004", '<c1 lc="1">0.004', "changes in time"),
    "unknown parameter": ("<t1>", "<t9>1</t9><t1>", "<t9>: .*this parameter"),
    "augmented": ("<g0>", "<laugon>1</laugon><g0>", "augmented"),
    "no load curve": ('<value lc="1">-1', '<value lc="7">-1', "no load curve '7'"),
    "curve goes back": ("<pt>2,3</pt>", "<pt>-2,3</pt>", "forward in time"),
    "curve unknown": ("LINEAR", "CUBIC SPLINE", "CUBIC SPLINE.*is not supported; use LINEAR"),
    "nothing moves": ("<pt>2,3</pt>", "<pt>2,0</pt>", "nothing moves"),
    "other condition": ('type="prescribed displacement"', 'type="linear constraint"', "linear constraint"),
    "condition without set": ('bc node_set="top"', 'bc node_set="tip"', "no node set 'tip'"),
    "rigid body missing": ("<rb>steel</rb><dof>", "<rb>wood</rb><dof>", "no rigid body 'wood'"),
    "tied contact": ('type="sliding-elastic"', 'type="tied-elastic"', "tied-elastic"),
    "friction": ('"pair"/>', '"pair"><fric_coeff>-1</fric_coeff></contact>', "is negative"),
    "billions of steps": ("<time_steps>4", "<time_steps>1e12", "1e\\+12 steps"),
    "dynamic": ("STATIC", "DYNAMIC", "DYNAMIC is not supported"),
    "loads": ("</Mesh>", '</Mesh><Loads><nodal_load type="nodal_load"/></Loads>', "load 'nodal_load' is not"),
    "other units": (
        'type="solid"/>', 'type="solid"><units>mm-kg-s</units></Module>',
        "<Module>: units 'mm-kg-s' are not supported; scale the input to mm-N-s",
    ),
    "another module": ('type="solid"', 'type="biphasic"', "biphasic"),
    "another section": ("</Mesh>", "</Mesh><Chemistry/>", "<Chemistry>: this section"),
    "other files": ("<Boundary>", '<Boundary from="/etc/passwd">', "another file"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_it_is_refused_in_one_line(tmp_path, name):
    old, new, fragment = CASES[name]
    assert FEB.count(old) >= 1
    file = written(tmp_path, FEB.replace(old, new, 1))
    with pytest.raises(ProblemError, match=fragment) as caught:
        run_feb(file, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)
    assert not (tmp_path / "out").exists()


BOMB = '<!DOCTYPE b [<!ENTITY a "ha">' + "".join(
    f'<!ENTITY {chr(b + 1)} "{f"&{chr(b)};" * 10}">' for b in range(ord("a"), ord("a") + 12)
)
HOSTILE = {
    "bomb": BOMB + "]><febio_spec version='4.0'>&m;</febio_spec>",
    "a file of this machine": '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/hostname">]><a>&x;</a>',
    "the network": '<!DOCTYPE a SYSTEM "http://192.0.2.1/a.dtd"><a/>',
    "parameter entity": '<!DOCTYPE a [<!ENTITY % x SYSTEM "http://192.0.2.1/a"> %x;]><a/>',
}


def refuse_in(file, said):
    """Bytes of memory in which a file is refused."""
    tracemalloc.start()
    with pytest.raises(ProblemError, match=said):
        read_feb(file)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


@pytest.mark.parametrize("name", HOSTILE)
def test_entities_are_never_read(tmp_path, name):
    assert refuse_in(written(tmp_path, HOSTILE[name]), "document type") < 5e6


def test_a_file_of_gigabytes_is_not_read(tmp_path):
    file = tmp_path / "huge.feb"
    with file.open("wb") as stream:
        stream.truncate(3 * 2**30)  # sparse
    with pytest.raises(ProblemError, match="3072 MB; no more than 256"):
        read_feb(file)


def test_memory_stays_in_proportion(tmp_path):
    """A hundred thousand empty elements take no more than four kilobytes each."""
    text = "<febio_spec version='4.0'>" + "<a/>" * 10**5 + "</febio_spec>"
    assert refuse_in(written(tmp_path, text), "<a>: this section is not supported") < 4e8


def test_tables_stay_in_their_folder(tmp_path):
    """A file name of the input leads nowhere else."""
    output = '<Output><logfile><node_data data="ux" file="../../x.txt"/></logfile></Output></febio_spec>'
    model = read_feb(written(tmp_path, FEB.replace("</febio_spec>", output)))
    assert [request.file for request in model.requests] == ["x.txt"]
