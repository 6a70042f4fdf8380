"""The C++ class, called beside the functions of the header, by two compilers."""

import shutil
import subprocess

import numpy as np
import pytest

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.shapes import pose_table
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Werror")
FRAME = (0.0, 0.0, 0.0, 1.0)
CLIP = HeldClip("pinned", (0.3, 0.05, -0.02), 0.35)
MODELS = {
    "plane": CableModel(CableData(0.8, 0.1, 0.01, 0.05), 6, "arc", n_rest=0),
    "space, clip, obstacles": CableModel(
        *(CableData(0.8, 0.05, 0.01, 0.05, torsional_stiffness=0.04), 6, "arc"),
        *("clamped", "clamped", (0.0, 0.0, -9.81)),
        n_rest=0,
        clips=("pinned",),
    ),
}
POSES = {
    "plane": [HeldPose((0.0, 0.0), (x, 0.1)) for x in (0.5, 0.52, 3.0)],
    "space, clip, obstacles": [
        HeldPose(
            *((0.0, 0.0, 0.0), (x, 0.1, 0.0)),
            start_orientation=FRAME,
            end_orientation=FRAME,
            clips=(CLIP,),
        )
        for x in (0.6, 0.62, 3.0)
    ],
}
CALLER = r"""
#include "rope_solver.hpp"
#include "rope_solver.hpp"

#include <cstdio>
#include <cstring>
#include <string>

#define EXPECT(what)                                                           \
    do {                                                                       \
        if (!(what)) {                                                         \
            std::printf("line %d: %s\n", __LINE__, #what);                     \
            return 1;                                                          \
        }                                                                      \
    } while (0)

#if ROPE_OBSTACLES
#define AMONG(of) (of).data(), (of).size(),
#else
#define AMONG(of)
#endif

template <class T> bool same(const T &a, const T &b) { return std::memcmp(&a, &b, sizeof a) == 0; }

template <class Call> rope_status thrown(Call call)
{
    try {
        call();
    } catch (const rope::Error &error) {
        return error.what() == std::string(rope_message(error.status)) ? error.status : ROPE_OK;
    }
    return ROPE_OK;
}

int main()
{
    static double work[ROPE_WORKSPACE_SIZE];
    const std::size_t size = ROPE_WORKSPACE_SIZE, count = 3;
    static const double numbers[] = {@POSES@};
    std::vector<rope_pose> poses(count);
    static_assert(sizeof numbers == 3 * sizeof(rope_pose), "numbers of three poses");
    std::memcpy(poses.data(), numbers, sizeof numbers);
    const std::vector<rope_pose> good(poses.begin(), poses.begin() + 2);
    rope_obstacle floor = {ROPE_HALF_SPACE, {}, {}, 0.0}, ball = {ROPE_CAPSULE, {}, {}, 0.02};
    floor.a[ROPE_DIMENSION - 1] = -0.4;
    floor.b[ROPE_DIMENSION - 1] = 1.0;
    ball.a[0] = ball.b[0] = 0.3;
    ball.a[1] = ball.b[1] = 0.4;
    const std::vector<rope_obstacle> around = {floor, ball};

    rope::Solver solver;
#if ROPE_OBSTACLES
    const std::vector<rope_obstacle> &touched = solver.obstacles;
    solver.obstacles = {floor};
#endif
    rope_shape shape, shapes[3], stepped;
    EXPECT(rope_solve(&poses[0], AMONG(touched) ROPE_LOWEST, nullptr, &shape, work, size) ==
           ROPE_OK);
    EXPECT(same(solver.solve(poses[0]), shape));
    EXPECT(thrown([&] { solver.solve(poses[2]); }) == ROPE_UNREACHABLE);
    EXPECT(rope_step(&poses[1], AMONG(touched) &shape, 6, &stepped, work, size) == ROPE_OK);
    EXPECT(same(solver.step(poses[1], shape, 6), stepped));

    /* Independent poses: those without a shape are told, or thrown. */
    rope_status statuses[3];
    std::vector<rope_status> told;
    EXPECT(rope_batch(poses.data(), count, AMONG(touched) ROPE_LOWEST, shapes, statuses, work,
                      size) == ROPE_UNREACHABLE);
    std::vector<rope_shape> found = solver.batch(poses, ROPE_LOWEST, &told);
    EXPECT(found.size() == count && told.size() == count && told[2] == ROPE_UNREACHABLE);
    EXPECT(std::memcmp(found.data(), shapes, sizeof shapes) == 0);
    EXPECT(std::memcmp(told.data(), statuses, sizeof statuses) == 0);
    EXPECT(found[2].energy == 0.0 && found[1].energy != 0.0);
    EXPECT(thrown([&] { solver.batch(poses); }) == ROPE_UNREACHABLE);
    EXPECT(solver.batch(good).size() == 2 && same(solver.batch(good)[1], shapes[1]));
    EXPECT(solver.batch({}).empty());

    /* A path. */
    std::size_t jump = 9, first = 9;
    EXPECT(rope_path(poses.data(), count, AMONG(touched) ROPE_LOWEST, nullptr, shapes, statuses,
                     &jump, work, size) == ROPE_UNREACHABLE);
    found = solver.path(poses, first, ROPE_LOWEST, nullptr, &told);
    EXPECT(jump == 2 && first == jump && told[1] == ROPE_OK && told[2] == ROPE_UNREACHABLE);
    EXPECT(std::memcmp(found.data(), shapes, sizeof shapes) == 0);
    EXPECT(thrown([&] { solver.path(poses, first); }) == ROPE_UNREACHABLE);
    EXPECT(same(solver.path(good, first)[1], shapes[1]) && first == 2);
    EXPECT(solver.path({}, first).empty() && first == 0);

    /* Derivatives, clearance and limits. */
    static rope_slope slope;
    EXPECT(rope_sensitivity(&poses[0], AMONG(touched) &shape, &slope, work, size) == ROPE_OK);
    const rope_slope own = solver.sensitivity(poses[0], shape);
    EXPECT(same(own.points, slope.points) && same(own.end_force, slope.end_force));
    rope_gap gap;
    EXPECT(rope_clearance(&shape, around.data(), 2, &slope, &gap) == ROPE_OK);
    EXPECT(same(solver.clearance(shape, around, &own), gap) && gap.gradient[0] != 0.0);
    EXPECT(same(rope::Solver::clearance(shape, around).distance, gap.distance));
    EXPECT(thrown([&] { solver.clearance(shape, {}); }) == ROPE_BAD_ARGUMENT);

    rope::Limits most;
    EXPECT(solver.limits(shape, most).kept());
    most.bend_radius = 0.01;
    most.force = 50.0;
    most.moment = 40.0;
    most.twist = 30.0;
    most.clearance = 0.001;
    const double limits[] = {0.01, 50.0, 40.0, 30.0, 0.001}; /* by rope_quantity */
    static_assert(sizeof limits == ROPE_QUANTITIES * sizeof(double), "a limit for each quantity");
    rope_usage usages[ROPE_QUANTITIES];
    rope_quantity tightest;
    EXPECT(rope_limits(&shape, limits, around.data(), 2, &slope, usages, &tightest) == ROPE_OK);
    rope::Usages used = solver.limits(shape, most, around, &own);
    EXPECT(used.tightest == tightest && used.kept());
    for (int k = 0; k < ROPE_QUANTITIES; ++k) {
        const rope_usage &one = used[static_cast<rope_quantity>(k)];
        EXPECT(same(one.value, usages[k].value) && same(one.margin, usages[k].margin));
        EXPECT(same(one.gradient, usages[k].gradient) && one.which == usages[k].which);
    }
    most.force = 1e-6;
    used = solver.limits(shape, most, around);
    EXPECT(!used.kept() && used.tightest == ROPE_FORCE && used[ROPE_FORCE].margin < 0.0);
    most.twist = -1.0;
    EXPECT(thrown([&] { solver.limits(shape, most); }) == ROPE_BAD_ARGUMENT);
    return 0;
}
"""


@pytest.fixture(scope="module", params=MODELS)
def folder(request, tmp_path_factory):
    """A compiled solver, and a caller of both of its interfaces."""
    model = MODELS[request.param]
    obstacles = 2 * ("obstacles" in request.param)
    rest = np.zeros(model.chain.n_rests)
    found = tmp_path_factory.mktemp("cplusplus")
    generate(model, model.nominal, rest, "rope", obstacles=obstacles).write(found)
    table, _ = pose_table(model, POSES[request.param])
    numbers = ", ".join(map(repr, table.ravel().tolist()))
    (found / "caller.cpp").write_text(CALLER.replace("@POSES@", numbers))
    subprocess.run(["cc", "-O0", "-c", "rope_solver.c"], cwd=found, check=True)
    return found


@pytest.mark.parametrize(
    ("compiler", "standard"),
    [
        ("g++", "c++11"),
        ("clang++", "c++11"),
        *(pytest.param(c, "c++20", marks=pytest.mark.long) for c in ("g++", "clang++")),
    ],
)
def test_the_class_gives_what_the_functions_give_and_throws_what_fails(folder, compiler, standard):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    name = f"{compiler}_{standard}"
    for command in (
        [compiler, f"-std={standard}", *WARNINGS, "caller.cpp", "rope_solver.o", "-o", name],
        [f"./{name}"],
    ):
        run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_the_source_is_c_plus_plus_as_well(folder, compiler):
    """Some build systems compile everything as C++."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    flags = ["-std=c++11", *WARNINGS[:3], "-Werror", "-fsyntax-only", "-x", "c++"]
    run = subprocess.run([compiler, *flags, "rope_solver.c"], cwd=folder, capture_output=True)
    assert run.returncode == 0, run.stderr.decode()
