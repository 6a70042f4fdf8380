"""Output is whole or as it was, and an error says where, why and what to try."""

import os
import resource
from contextlib import contextmanager
from pathlib import Path

import pytest
from files import tree

from dlo_casadi.errors import OutputError
from dlo_casadi.io.files import FolderDraft, refuse_foreign, write_file

REMEDY = r"\n  Try: another place, or check its permissions and the free space"


@contextmanager
def no_more_than(size):
    """The system refuses to write a file beyond so many bytes, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def full(*_):
    raise OSError(28, os.strerror(28))


# ---- files -------------------------------------------------------------------------------------


def in_halves(stream):
    stream.write(b"x" * 3000)
    stream.write(b"x" * 3000)


@pytest.mark.parametrize("content", ["x" * 6000, b"x" * 6000, in_halves])
def test_a_disk_that_is_full_half_way_leaves_the_earlier_file(tmp_path, content):
    path = tmp_path / "a.txt"
    write_file(path, "earlier")
    with (
        no_more_than(4096),
        pytest.raises(OutputError, match=f"a.txt cannot be written: File too large.{REMEDY}") as e,
    ):
        write_file(path, content)
    assert e.value.path == path
    assert tree(tmp_path) == {"a.txt": b"earlier"}

    write_file(path, content)
    assert tree(tmp_path) == {"a.txt": b"x" * 6000}


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_disk_that_is_full_at_the_end_leaves_the_earlier_file(tmp_path, monkeypatch, step):
    write_file(tmp_path / "a.txt", "earlier")
    monkeypatch.setattr(os, step, full)
    with pytest.raises(OutputError, match=f"cannot be written: No space left on device.{REMEDY}"):
        write_file(tmp_path / "a.txt", "later")
    assert tree(tmp_path) == {"a.txt": b"earlier"}


def test_an_interrupt_leaves_the_earlier_file(tmp_path):
    def interrupted(stream):
        stream.write(b"half")
        raise KeyboardInterrupt

    write_file(tmp_path / "a.txt", "earlier")
    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "a.txt", interrupted)
    assert tree(tmp_path) == {"a.txt": b"earlier"}


def test_what_is_in_the_way_of_a_file_stays(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")
    before = tree(tmp_path)
    for path, reason in (
        (tmp_path / "folder", "Is a directory"),
        (tmp_path / "file" / "a.txt", "Not a directory"),
        (tmp_path / ("a" * 300), "File name too long"),
    ):
        with pytest.raises(OutputError, match=f"cannot be written: {reason}.{REMEDY}"):
            write_file(path, "text")
    assert tree(tmp_path) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is read-only to root")
def test_a_folder_that_is_read_only(tmp_path):
    (tmp_path / "a.txt").write_text("earlier")
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(OutputError, match=f"cannot be written: Permission denied.{REMEDY}"):
            write_file(tmp_path / "a.txt", "later")
        with pytest.raises(OutputError, match="denied"), FolderDraft(tmp_path / "a" / "b"):
            pass
        assert tree(tmp_path) == {"a.txt": b"earlier"}
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="no /sys")
def test_a_folder_that_is_read_only_to_everyone():
    with pytest.raises(OutputError, match=f"/sys/kernel/a cannot be written: .*{REMEDY}"):
        write_file(Path("/sys/kernel/a"), "text")
    with (
        pytest.raises(OutputError, match=f"/sys/kernel/a cannot be written: .*{REMEDY}"),
        FolderDraft("/sys/kernel/a"),
    ):
        pass


def test_a_file_has_the_permissions_of_any_other(tmp_path):
    before = os.umask(0o027)
    try:
        write_file(tmp_path / "a.txt", "text")
    finally:
        os.umask(before)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o640


def test_a_link_leads_where_it_did_and_a_name_may_be_long(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link.txt").symlink_to(tmp_path / "there" / "a.txt")
    write_file(tmp_path / "link.txt", "text")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "there" / "a.txt").read_text() == "text"
    write_file(tmp_path / ("a" * 255), "text")  # the longest name that ext4 and APFS permit


def test_text_is_utf_8_and_a_lone_surrogate_its_escape(tmp_path):
    write_file(tmp_path / "a.txt", "ä, \U0001f600, " + os.fsdecode(b"caf\xe9") + "\ud800\r\n")
    assert (tmp_path / "a.txt").read_bytes().decode() == "ä, \U0001f600, caf\\udce9\\ud800\r\n"


def test_a_draft_with_a_name_is_written_over_by_the_next(tmp_path):
    draft = tmp_path / "draft"
    draft.write_text("of a process that was killed")
    write_file(tmp_path / "a.txt", "whole", draft)
    assert tree(tmp_path) == {"a.txt": b"whole"}


# ---- folders -----------------------------------------------------------------------------------

NAMES = ("a.txt", "b.txt", "folder", "obsolete")


@pytest.fixture
def earlier(tmp_path):
    """An earlier output, with a file of the user's."""
    folder = tmp_path / "out"
    (folder / "folder").mkdir(parents=True)
    for name in ("a.txt", "folder/old.txt", "obsolete", "mine.txt"):
        (folder / name).write_text("earlier")
    return folder


def fill(draft):
    write_file(draft.folder / "a.txt", "later")
    write_file(draft.folder / "b.txt", "later")
    (draft.folder / "folder").mkdir()
    write_file(draft.folder / "folder" / "new.txt", "later")


def give_up(draft, error):
    fill(draft)
    raise error("given up")


def test_what_a_killed_process_has_left_in_a_draft_is_not_kept(tmp_path):
    with FolderDraft(tmp_path / "out") as draft:
        fill(draft)
        (draft.folder / ".dlo-draft-0123456789abcdef").write_text("half")
        draft.put_in_place()
    assert not list((tmp_path / "out").rglob(".*"))


def replace_all(folder, before_the_end=lambda: None):
    with FolderDraft(folder) as draft:
        fill(draft)
        assert (folder / "a.txt").read_text() == "earlier"
        before_the_end()
        draft.put_in_place(NAMES)


def test_entries_are_replaced_as_wholes_and_others_stay(earlier):
    replace_all(earlier)
    found = tree(earlier)
    assert found.pop("folder") is None
    assert found == {
        "a.txt": b"later",
        "b.txt": b"later",
        "folder/new.txt": b"later",
        "mine.txt": b"earlier",
    }


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("moves", range(6))
def test_a_failure_at_any_renaming_is_undone(earlier, monkeypatch, moves, error):
    """Three entries are moved out and three in."""
    before, left, rename = tree(earlier), [moves], os.replace

    def fails_once(origin, goal):
        left[0] -= 1
        if left[0] == -1:
            raise error
        rename(origin, goal)

    raised = OutputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(raised):
        replace_all(earlier, lambda: monkeypatch.setattr(os, "replace", fails_once))
    assert left[0] < 0
    assert tree(earlier) == before


def test_what_cannot_be_put_back_is_kept_and_its_place_told(earlier, monkeypatch):
    """From the third renaming on all fail: a.txt has been moved out and in."""
    left, rename = [2], os.replace

    def fails(origin, goal):
        left[0] -= 1
        if left[0] < 0:
            full()
        rename(origin, goal)

    with pytest.raises(OutputError) as caught:
        replace_all(earlier, lambda: monkeypatch.setattr(os, "replace", fails))
    (note,) = caught.value.__notes__
    kept = Path(note.split(" is in part in ")[1].rstrip("."))
    assert (kept / "a.txt").read_text() == "earlier"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, OutputError])
def test_a_draft_that_is_given_up_leaves_no_trace(earlier, error):
    before = tree(earlier)
    for path in (earlier, earlier.parent / "x" / "y"):
        with pytest.raises(error), FolderDraft(path) as draft:
            give_up(draft, error)
    assert tree(earlier) == before
    assert list(earlier.parent.iterdir()) == [earlier]


def test_a_file_in_place_of_a_folder_stays(tmp_path):
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file", tmp_path / "file" / "out"):
        with (
            pytest.raises(OutputError, match=f"{path} cannot be written: .*\n  Try: another"),
            FolderDraft(path),
        ):
            pass
    assert tree(tmp_path) == {"file": b"mine"}


def test_another_run_may_make_the_same_parents(tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    monkeypatch.setattr(os.path, "exists", lambda path: False)  # as of before it did
    with FolderDraft(tmp_path / "results" / "new" / "cable"):
        assert (tmp_path / "results" / "new").is_dir()
    assert list(tmp_path.rglob("*")) == [tmp_path / "results"]


def test_names_from_elsewhere_are_refused(tmp_path):
    refuse_foreign(tmp_path, [])
    with pytest.raises(OutputError, match=r"holds a, b from elsewhere.*\n  Try: another folder"):
        refuse_foreign(tmp_path, ["a", "b"])
