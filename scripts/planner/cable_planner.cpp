// Plans a motion of the gripper that holds a cable's end through a scene of obstacles, with OMPL.
//
// A state is the gripper's place, in space its place and orientation, in SE(3); the shape of the
// cable there comes from the generated solver. Clips may hold the cable on its way. A state is valid
// if the shape keeps the limits: the whole cable clear of the obstacles, bent and twisted no more
// than allowed, and no fixture, clip or gripper pulled harder. A motion is valid if the cable can be
// led along it without snapping over or looping, and all its shapes are valid. Prints a line for each
// shape along the path: its nodes, then least bend radius [m], greatest force [N] and moment [N m] on
// a fixture, twist [1/m] and distance from the obstacles [m]; and on the standard error how often
// each limit has turned a state or a motion down.
//
//   cable_planner <scene file> <branch: ccw or cw, in space lowest> <iterations> <seed>
//
// Scene file, one item a line [m]; a place has as many numbers as the cable has dimensions:
//   start PLACE | goal PLACE | low PLACE | high PLACE     of the gripper; start and goal in space
//                                                         with its orientation qx qy qz qw
//   held qx qy qz qw                                      of the cable's start, in space
//   capsule PLACE PLACE radius | half_space PLACE NORMAL  obstacles; equal places are a sphere
//   clip at PLACE                                         pinned, in the order along the cable
//   bend_radius r | force f | moment m | twist t | clearance c     limits [m, N, N m, 1/m, m]

#include <dlo_solver.h>

#include <ompl/base/ProblemDefinition.h>
#include <ompl/base/objectives/PathLengthOptimizationObjective.h>
#include <ompl/base/spaces/RealVectorStateSpace.h>
#include <ompl/base/spaces/SE3StateSpace.h>
#include <ompl/base/terminationconditions/IterationTerminationCondition.h>
#include <ompl/geometric/PathGeometric.h>
#include <ompl/geometric/planners/rrt/RRTstar.h>
#include <ompl/util/Console.h>
#include <ompl/util/RandomNumbers.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <iterator>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace ob = ompl::base;
namespace og = ompl::geometric;

constexpr unsigned D = DLO_DIMENSION;
using Place = std::array<double, D>;
using Turn = std::array<double, 4>;

struct Scene {
    Place start{}, goal{}, low{}, high{};
    Turn start_turn{0.0, 0.0, 0.0, 1.0}, goal_turn{0.0, 0.0, 0.0, 1.0}, held{0.0, 0.0, 0.0, 1.0};
    double limits[DLO_QUANTITIES] = {};
    std::vector<std::pair<double, Place>> clips;
    std::vector<dlo_obstacle> obstacles;
};

// Names of limits in scene files, by dlo_quantity.
static const char *const NAMES[] = {"bend_radius", "force", "moment", "twist", "clearance"};
static_assert(std::size(NAMES) == DLO_QUANTITIES);

template <typename Numbers>
static void read(std::ifstream &file, Numbers &numbers)
{
    for (double &number : numbers)
        file >> number;
}

static void read_turn(std::ifstream &file, Turn &turn)
{
    read(file, turn);
    const double size = std::sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2] +
                                  turn[3] * turn[3]);
    for (double &number : turn)
        number /= size; // written with a few digits
}

static Scene read_scene(const char *name)
{
    Scene scene;
    std::ifstream file(name);
    std::string word;
    while (file >> word) {
        dlo_obstacle obstacle{};
        if (word == "start" || word == "goal") {
            read(file, word == "start" ? scene.start : scene.goal);
            if (D == 3)
                read_turn(file, word == "start" ? scene.start_turn : scene.goal_turn);
        } else if (word == "held") {
            read_turn(file, scene.held);
        } else if (word == "low" || word == "high") {
            read(file, word == "low" ? scene.low : scene.high);
        } else if (word == "capsule" || word == "half_space") {
            obstacle.kind = word == "capsule" ? DLO_CAPSULE : DLO_HALF_SPACE;
            read(file, obstacle.a);
            read(file, obstacle.b);
            if (word == "capsule")
                file >> obstacle.radius;
            scene.obstacles.push_back(obstacle);
        } else if (word == "clip") {
            std::pair<double, Place> clip;
            file >> clip.first;
            read(file, clip.second);
            scene.clips.push_back(clip);
        } else if (std::find(std::begin(NAMES), std::end(NAMES), word) != std::end(NAMES)) {
            file >> scene.limits[std::find(std::begin(NAMES), std::end(NAMES), word) - NAMES];
        } else {
            std::cerr << name << ": unknown item " << word << "\n";
            std::exit(2);
        }
    }
    if (scene.clips.size() != DLO_CLIPS) {
        std::cerr << name << ": " << scene.clips.size() << " clips, the solver has " << DLO_CLIPS
                  << "\n";
        std::exit(2);
    }
    return scene;
}

// What differs between the plane and space: the gripper's states, and poses.
#if DLO_DIMENSION == 3
using Space = ob::SE3StateSpace;
static std::shared_ptr<Space> make_space() { return std::make_shared<Space>(); }

static void put(ob::State *state, const Place &place, const Turn &turn)
{
    auto *at = state->as<Space::StateType>();
    at->setXYZ(place[0], place[1], place[2]);
    at->rotation().x = turn[0];
    at->rotation().y = turn[1];
    at->rotation().z = turn[2];
    at->rotation().w = turn[3];
}

static dlo_pose ends_of(const Scene &scene, const ob::State *state)
{
    const auto *at = state->as<Space::StateType>();
    const auto &turn = at->rotation();
    dlo_pose pose{};
    const Place end{at->getX(), at->getY(), at->getZ()};
    const Turn last{turn.x, turn.y, turn.z, turn.w};
    std::copy(end.begin(), end.end(), pose.end);
    std::copy(scene.held.begin(), scene.held.end(), pose.start_orientation);
    std::copy(last.begin(), last.end(), pose.end_orientation);
    return pose;
}

static dlo_branch branch_of(const std::string &) { return DLO_LOWEST; }
#else
using Space = ob::RealVectorStateSpace;
static std::shared_ptr<Space> make_space() { return std::make_shared<Space>(D); }

static void put(ob::State *state, const Place &place, const Turn &)
{
    for (unsigned k = 0; k < D; ++k)
        state->as<Space::StateType>()->values[k] = place[k];
}

static dlo_pose ends_of(const Scene &, const ob::State *state)
{
    dlo_pose pose{};
    std::copy_n(state->as<Space::StateType>()->values, D, pose.end);
    return pose;
}

static dlo_branch branch_of(const std::string &word) { return word == "cw" ? DLO_CW : DLO_CCW; }
#endif

static dlo_pose pose_of(const Scene &scene, const ob::State *state)
{
    dlo_pose pose = ends_of(scene, state);
#if DLO_CLIPS
    for (std::size_t k = 0; k < DLO_CLIPS; ++k) {
        pose.clips[k].at = scene.clips[k].first;
        std::copy(scene.clips[k].second.begin(), scene.clips[k].second.end(), pose.clips[k].place);
    }
#endif
    return pose;
}

// The cable in the scene: one workspace, so one object for each thread.
class Cable {
public:
    Cable(Scene scene, dlo_branch branch)
        : scene_(std::move(scene)), branch_(branch), work_(DLO_WORKSPACE_SIZE)
    {
    }

    // Whether the gripper may be in a state, alone.
    bool place(const ob::State *state)
    {
        dlo_shape shape;
        return judge(solve(state, shape) ? limit(shape) : "no equilibrium", "state");
    }

    // Shapes along a motion; empty if it is not possible.
    std::vector<dlo_shape> lead(const ob::SpaceInformation &space, const ob::State *from,
                                const ob::State *to)
    {
        // A step of 1 cm; OMPL's distance in SE(3) adds that and an angle [rad].
        const auto count = 2 + static_cast<std::size_t>(space.distance(from, to) / 0.01);
        std::vector<dlo_pose> poses(count);
        std::vector<dlo_shape> shapes(count);
        std::vector<dlo_status> statuses(count);
        std::size_t jump = 0;
        ob::State *at = space.allocState();
        for (std::size_t i = 0; i < count; ++i) {
            const double u = static_cast<double>(i) / static_cast<double>(count - 1);
            space.getStateSpace()->interpolate(from, to, u, at);
            poses[i] = pose_of(scene_, at);
        }
        space.freeState(at);
        solves += count;
        const dlo_status status =
            dlo_path(poses.data(), count, branch_, nullptr, shapes.data(), statuses.data(), &jump,
                     work_.data(), work_.size());
        const char *why = status != DLO_OK ? "no equilibrium" : (jump < count ? "snap" : nullptr);
        for (std::size_t i = 0; !why && i < count; ++i)
            why = limit(shapes[i]);
        if (!why && !leads_to(to, shapes.back()))
            why = "another shape";
        return judge(why, "motion") ? shapes : std::vector<dlo_shape>();
    }

    // How much of its limits a shape uses; the tightest one.
    dlo_quantity use(const dlo_shape &shape, dlo_usage *usages) const
    {
        dlo_quantity tightest;
        dlo_limits(&shape, scene_.limits, scene_.obstacles.data(), scene_.obstacles.size(), nullptr,
                   usages, &tightest);
        return tightest;
    }

    std::size_t solves = 0;
    std::map<std::string, std::size_t> refused;

private:
    bool solve(const ob::State *state, dlo_shape &shape)
    {
        const dlo_pose at = pose_of(scene_, state);
        ++solves;
        return dlo_solve(&at, branch_, nullptr, &shape, work_.data(), work_.size()) == DLO_OK;
    }

    // The limit that a shape does not keep, or none.
    const char *limit(const dlo_shape &shape) const
    {
        dlo_usage usages[DLO_QUANTITIES];
        const dlo_quantity tightest = use(shape, usages);
        return usages[tightest].margin < 0.0 ? NAMES[tightest] : nullptr;
    }

    // The shape that a motion leads to must be the one that the state stands for.
    bool leads_to(const ob::State *state, const dlo_shape &shape)
    {
        dlo_shape own;
        if (!solve(state, own))
            return false;
        for (int i = 0; i <= DLO_N; ++i)
            for (unsigned k = 0; k < D; ++k)
                if (std::fabs(own.points[i][k] - shape.points[i][k]) > 1e-6)
                    return false;
        return true;
    }

    bool judge(const char *why, const char *what)
    {
        if (why)
            ++refused[std::string(why) + " of a " + what];
        return !why;
    }

    Scene scene_;
    dlo_branch branch_;
    std::vector<double> work_;
};

class Leading : public ob::MotionValidator {
public:
    Leading(const ob::SpaceInformationPtr &space, Cable &cable)
        : ob::MotionValidator(space), cable_(cable)
    {
    }

    bool checkMotion(const ob::State *from, const ob::State *to) const override
    {
        return !cable_.lead(*si_, from, to).empty();
    }

    // The share up to which the motion is possible is not needed by the planner used here.
    bool checkMotion(const ob::State *from, const ob::State *to,
                     std::pair<ob::State *, double> &last) const override
    {
        last.second = 0.0;
        if (last.first)
            si_->copyState(last.first, from);
        return checkMotion(from, to);
    }

private:
    Cable &cable_;
};

int main(int argc, char **argv)
{
    if (argc != 5) {
        std::cerr << "usage: cable_planner <scene file> <ccw, cw or lowest> <iterations> <seed>\n";
        return 2;
    }
    ompl::msg::setLogLevel(ompl::msg::LOG_WARN);
    ompl::RNG::setSeed(static_cast<unsigned>(std::atoi(argv[4])));
    const Scene scene = read_scene(argv[1]);
    Cable cable(scene, branch_of(argv[2]));

    auto space = make_space();
    ob::RealVectorBounds bounds(D);
    for (unsigned k = 0; k < D; ++k) {
        bounds.setLow(k, scene.low[k]);
        bounds.setHigh(k, scene.high[k]);
    }
    space->setBounds(bounds);
    auto information = std::make_shared<ob::SpaceInformation>(space);
    information->setStateValidityChecker(
        [&cable](const ob::State *state) { return cable.place(state); });
    information->setMotionValidator(std::make_shared<Leading>(information, cable));
    information->setup();

    ob::ScopedState<Space> start(space), goal(space);
    put(start.get(), scene.start, scene.start_turn);
    put(goal.get(), scene.goal, scene.goal_turn);
    auto problem = std::make_shared<ob::ProblemDefinition>(information);
    problem->setStartAndGoalStates(start, goal, 1e-3);
    problem->setOptimizationObjective(
        std::make_shared<ob::PathLengthOptimizationObjective>(information));
    auto planner = std::make_shared<og::RRTstar>(information);
    planner->setRange(D == 3 ? 0.4 : 0.15);
    planner->setGoalBias(0.1);
    planner->setProblemDefinition(problem);
    planner->setup();
    ob::IterationTerminationCondition iterations(static_cast<unsigned>(std::atoi(argv[3])));
    const ob::PlannerStatus status = planner->solve(iterations);
    std::cerr << "solver calls: " << cable.solves << "\n";
    for (const auto &[why, count] : cable.refused)
        std::cerr << "turned down for " << why << ": " << count << "\n";
    if (status != ob::PlannerStatus::EXACT_SOLUTION) {
        std::cerr << "no path: " << status.asString() << "\n";
        return 1;
    }
    const auto *path = problem->getSolutionPath()->as<og::PathGeometric>();
    std::cerr << "path of the gripper: " << path->length() << (D == 3 ? " m + rad\n" : " m\n");
    for (unsigned k = 1; k < path->getStateCount(); ++k) {
        const auto shapes = cable.lead(*information, path->getState(k - 1), path->getState(k));
        if (shapes.empty()) {
            std::cerr << "the path is not valid\n";
            return 1;
        }
        for (const dlo_shape &shape : shapes) {
            for (const auto &point : shape.points)
                for (double number : point)
                    std::printf("%.6f ", number);
            dlo_usage usages[DLO_QUANTITIES];
            cable.use(shape, usages);
            for (const dlo_usage &usage : usages)
                std::printf("%.6g ", usage.value);
            std::printf("\n");
        }
    }
    return 0;
}
