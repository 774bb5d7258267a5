"""LZFSE against what Apple's own encoder made of the same bytes, and against damage."""

from __future__ import annotations

import base64
import struct

import numpy as np
import pytest

from taichi_unifusion.errors import FrameError
from taichi_unifusion.files import lzfse

# of `plain(count)`, as liblzfse compresses it: entropy coded, LZVN, stored
COMPRESSED = {
    4600: (
        "Vs>~k_z?gAYy!{^0EYn}W}CG^W#a-+pa1{>IwUXvAHdbYYNCn&g22(uSZUM5lR~Qd;^gS~1NZ>Wo`Dms+LY1NvG$"
        "rP9ZLfM00000JT#BOOYt{+72m>l!PCIoz#9Po000000000000000000000000000000000000000000000000000"
        "0000000000000000000000000DxiVKS99-#R*C(yOnK-b)uL=MKt3rA;t`qv_8DP4j4yeZvEJ#*Q2IDOgAbk#;B~"
        "soOuimSQ}Bi&n5(2m7&6$@Wb%wN5M)X0Ss%cgpOZUqAT$DRD7c;qG@~or0_~QxufCCHH=0b?by?{wYq4y2!(dKY~"
        "Q<NX>a%&GstKm%o-e0fv_HCdetbThG}eJHV_b|46;rV<i;kJw7v#~qySN?AN+a8=eFENczMG_T@6@%(YSX%Po{m8"
        "EXfG%85^+;$xpJT5K?eg(=P@v?T=(kH(6PxS4}Oj@G@+SvQB|cUBEg3hW`t0>4H~ADc`q*!TPWZ0ssI200000000"
        "0Ea24nCHnYn4Nul8Xh!3!)0&~^yX4on=?4n_Y!nQ-5bKwLkMzjR33r^ZQ+$~8tr}8&y&@G}yGl)P`b$bvjs2z@)-"
        "FMr~4GWki!WRaQPiaUUzBgNF_P+2h7a-_O(DP_h&IJicq2@>~c?Ao41OII?h$?X05<oNjFN&lGGZa4oqI*}<Ensq"
        "0H=B3_z8=dc97JC{ARU~j`{E6T*tR=J^ZcZEPYzMA+Qhh<kp@HY3@G}P8J_YGXm@0f%Is_k%ZXBn)F!A?Y7kPcED"
        "aw7Q%3Es7AX<2uS+O~$6kMv^y{++Nm*1!30K*02FGf;d!(k3@EO`t;8{e6nviQ5&S>!#(pTCrczg4u`Wmu88Kiog"
        "G2O`2g`X>;?FG-t)sYt!mHz(;ReN0o2BK_dc?GsG-(=Ad$afP1fjm-Cu;U?0BD)j3t`7@4dWk1Fyw^O-U8oiJ#5_"
        "YhHtYpP7G2e@Vx`OjSbZg-Q0U|og(f>(3Y&`dC7v7_oS-w!yv3U>>=UB%B68rm=g$vEhrGqk4P9I7=_ZJV2!Dh&)"
        "xUuFQH)K-28hGM1Vjn7M9j0j>flh<8<4?O@a=hFw%&|c&bA*f7zFx4>@3xlt@|Ax(q&`{zjPh&>n0U~N`x-55ytu"
        "}&S=Nih;mO>K-E7kG2n%^u2C%;^Wqm@oHyY6?1k(iZA{AUwm=Gccr98O3U49>8%WZmq-*P;nkzAg6-E^tY)|+k>;"
        "X6~IgjGg+U!C2TzrKNh@u$5Fzuw!6f=~lR2>5HDJ;}sL(VmZupQG50SkKsw_SAn2i9_|zO6eI|HyW@eHj{+wv|F{"
        "wxh)TIJ?Hv6KzJYK|?X!z4;i8He-A{Ri|{G2M=lV50IglHW<vG%}H$$p|35#6-^e!XZ@9fo>r(sN$7Hy+EM*24H7"
        "L{937bCSnZX&os-H6oY$^~ZkNo6OKj#hVs>~W"
    ),
    600: (
        "Vs?0LSONe51OWg5=L!M<0|Wv92mt^FkO~Y4hz0`;>IeY}015~M3IYKL9Y_ZZkOc(*h#(9G=l}!=00RI92sjq@<N*"
        "T)05})=08+>W1_cK4<NyQ!05~G@Kz;+59s>aO<O2c#2sk73I3D?E76AD`4+2ne1TYAI90~*w#Rvf?4rmbs@CnF71"
        "_}r$3RoTnI2ZG1A`JT=C^#ZG9{d;vKm!6G2UrpU7zP*^<pc!)0s{b%m<j*^^q5Nk0p|n+0s;XD1pyuA1Of#D1qcD"
        "jXbAxE<O~J^1UMd;3IG7~flUPkXc++i2v|50^#~6TmN+W-N)-mk0|Ed6m=6d7_u>cw1^@s600000Vs>~W"
    ),
    7: ("Vs>~f2LJ#73IYHF1OfnJc6cN"),
}


def plain(count: int) -> bytes:
    """Bytes with a few frequent values and with repetitions, always the same."""
    x, out = 1, bytearray()
    while len(out) < count:
        x = (x * 1103515245 + 12345) & 0x7FFFFFFF
        k = x >> 16
        if k % 5 == 0 and len(out) > 40:
            out += out[-(k % 37 + 1) :][: k % 23 + 3]
        else:
            out.append((k >> 7) % 7 * (k % 3))
    return bytes(out[:count])


def compressed(count: int) -> bytes:
    return base64.b85decode(COMPRESSED[count])


@pytest.fixture(params=["own", "package"])
def way(request, monkeypatch):
    """With our own decoder, and with the package where that is installed."""
    if request.param == "own":
        monkeypatch.setattr(lzfse, "_native", lambda data, size: None)
    else:
        pytest.importorskip("liblzfse")


@pytest.mark.parametrize("count", COMPRESSED)
def test_what_apple_compressed_comes_back(count, way):
    assert lzfse.decompress(compressed(count), count, "here") == plain(count)


def test_blocks_follow_one_another(way):
    every = b"".join(compressed(count)[:-4] for count in COMPRESSED) + b"bvx$"
    expected = b"".join(plain(count) for count in COMPRESSED)
    assert lzfse.decompress(every, len(expected), "here") == expected


def test_a_header_that_is_not_packed(monkeypatch):
    """`bvx1`, which encoders use on their way to `bvx2`."""
    monkeypatch.setattr(lzfse, "_native", lambda data, size: None)
    count = next(iter(COMPRESSED))
    packed = compressed(count)
    header = lzfse._header_v2(packed, 0)
    values = struct.pack(
        "<5Ii4HI3H360H",
        *(header.literal_bytes + header.match_bytes, header.literals, header.matches),
        *(header.literal_bytes, header.match_bytes, header.literal_bits, *header.literal_states),
        *(header.match_bits & 0xFFFFFFFF, *header.match_states, *header.frequencies),
    )
    plainly = b"bvx1" + struct.pack("<I", count) + values + packed[header.size :]
    assert lzfse.decompress(plainly, count, "here") == plain(count)


@pytest.mark.parametrize("size", [0, 6, 8])
def test_another_size_is_refused(size, way):
    with pytest.raises(FrameError, match="here: the LZFSE data are damaged"):
        lzfse.decompress(compressed(7), size, "here")


def test_damage_gives_an_error_or_as_many_bytes(way):
    """Every byte of every kind of block changed, and every length cut: no other error, no endless loop."""
    random = np.random.default_rng(0)
    for count in COMPRESSED:
        data = compressed(count)
        for at in random.choice(len(data), min(len(data), 120), replace=False):
            changed = bytearray(data)
            changed[at] ^= 1 << int(random.integers(8))
            for tried in (bytes(changed), data[:at]):
                try:
                    assert len(lzfse.decompress(tried, count, "here")) == count
                except FrameError as error:
                    assert str(error).startswith("here: the LZFSE data are damaged")
