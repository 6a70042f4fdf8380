// Plans a motion of a cable's held end through a scene of round obstacles, with OMPL.
//
// A state is the place of the held end; the shape of the cable there comes from the generated
// solver. A state is valid if the whole cable keeps clear of the obstacles and bends no tighter
// than allowed; a motion is valid if the cable can be led along it without snapping over, and
// all its shapes are valid. Prints the shapes along the path, one line of x y pairs each.
//
//   cable_planner <scene file> <branch: ccw or cw> <iterations> <seed>
//
// Scene file, one item a line [m]: start x y | goal x y | bend_radius r | clearance c |
// box x0 y0 x1 y1 (of the held end) | circle x y r

#include <dlo_solver.h>

#include <ompl/base/ProblemDefinition.h>
#include <ompl/base/objectives/PathLengthOptimizationObjective.h>
#include <ompl/base/spaces/RealVectorStateSpace.h>
#include <ompl/base/terminationconditions/IterationTerminationCondition.h>
#include <ompl/geometric/PathGeometric.h>
#include <ompl/geometric/planners/rrt/RRTstar.h>
#include <ompl/util/Console.h>
#include <ompl/util/RandomNumbers.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

namespace ob = ompl::base;
namespace og = ompl::geometric;

struct Circle {
    double x, y, r;
};

struct Scene {
    double start[2] = {0.0, 0.0}, goal[2] = {0.0, 0.0}, low[2] = {-1.0, -1.0}, high[2] = {1.0, 1.0};
    double bend_radius = 0.0, clearance = 0.0;
    std::vector<Circle> circles;
};

static Scene read_scene(const char *name)
{
    Scene scene;
    std::ifstream file(name);
    std::string word;
    while (file >> word) {
        if (word == "start")
            file >> scene.start[0] >> scene.start[1];
        else if (word == "goal")
            file >> scene.goal[0] >> scene.goal[1];
        else if (word == "bend_radius")
            file >> scene.bend_radius;
        else if (word == "clearance")
            file >> scene.clearance;
        else if (word == "box")
            file >> scene.low[0] >> scene.low[1] >> scene.high[0] >> scene.high[1];
        else if (word == "circle") {
            Circle c{};
            file >> c.x >> c.y >> c.r;
            scene.circles.push_back(c);
        }
    }
    return scene;
}

// The cable in the scene: one workspace, so one object for each thread.
class Cable {
public:
    Cable(Scene scene, dlo_branch branch)
        : scene_(std::move(scene)), branch_(branch), work_(DLO_WORKSPACE_SIZE)
    {
    }

    static dlo_pose pose(double x, double y)
    {
        dlo_pose out = {{0.0, 0.0}, {x, y}, 0.0, 0.0};
        return out;
    }

    bool solve(double x, double y, dlo_shape &shape)
    {
        const dlo_pose at = pose(x, y);
        ++solves;
        return dlo_solve(&at, branch_, nullptr, &shape, work_.data(), work_.size()) == DLO_OK;
    }

    bool clear(const dlo_shape &shape) const
    {
        if (shape.min_bend_radius < scene_.bend_radius)
            return false;
        for (const Circle &c : scene_.circles)
            for (int i = 0; i < DLO_N; ++i)
                if (distance(c, shape.points[i], shape.points[i + 1]) < c.r + scene_.clearance)
                    return false;
        return true;
    }

    // Shapes along a straight motion of the end; empty if it is not possible.
    std::vector<dlo_shape> lead(const double from[2], const double to[2])
    {
        const double way = std::hypot(to[0] - from[0], to[1] - from[1]);
        const std::size_t count = 2 + static_cast<std::size_t>(way / 0.01);
        std::vector<dlo_pose> poses(count);
        std::vector<dlo_shape> shapes(count);
        std::vector<dlo_status> statuses(count);
        std::size_t jump = 0;
        for (std::size_t i = 0; i < count; ++i) {
            const double u = static_cast<double>(i) / static_cast<double>(count - 1);
            poses[i] = pose(from[0] + u * (to[0] - from[0]), from[1] + u * (to[1] - from[1]));
        }
        solves += count;
        const dlo_status status =
            dlo_path(poses.data(), count, branch_, nullptr, shapes.data(), statuses.data(), &jump,
                     work_.data(), work_.size());
        dlo_shape own;
        if (status != DLO_OK || jump < count || !solve(to[0], to[1], own))
            return {};
        // The shape that the motion leads to must be the one that the state stands for.
        for (int i = 0; i <= DLO_N; ++i)
            if (std::hypot(own.points[i][0] - shapes.back().points[i][0],
                           own.points[i][1] - shapes.back().points[i][1]) > 1e-6)
                return {};
        for (const dlo_shape &shape : shapes)
            if (!clear(shape))
                return {};
        return shapes;
    }

    std::size_t solves = 0;

private:
    static double distance(const Circle &c, const double a[2], const double b[2])
    {
        const double x = b[0] - a[0], y = b[1] - a[1];
        const double u = ((c.x - a[0]) * x + (c.y - a[1]) * y) / (x * x + y * y);
        const double at = std::clamp(u, 0.0, 1.0);
        return std::hypot(a[0] + at * x - c.x, a[1] + at * y - c.y);
    }

    Scene scene_;
    dlo_branch branch_;
    std::vector<double> work_;
};

static const double *place(const ob::State *state)
{
    return state->as<ob::RealVectorStateSpace::StateType>()->values;
}

class Leading : public ob::MotionValidator {
public:
    Leading(const ob::SpaceInformationPtr &space, Cable &cable)
        : ob::MotionValidator(space), cable_(cable)
    {
    }

    bool checkMotion(const ob::State *from, const ob::State *to) const override
    {
        return !cable_.lead(place(from), place(to)).empty();
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
        std::cerr << "usage: cable_planner <scene file> <ccw or cw> <iterations> <seed>\n";
        return 2;
    }
    ompl::msg::setLogLevel(ompl::msg::LOG_WARN);
    ompl::RNG::setSeed(static_cast<unsigned>(std::atoi(argv[4])));
    const Scene scene = read_scene(argv[1]);
    Cable cable(scene, std::string(argv[2]) == "cw" ? DLO_CW : DLO_CCW);

    auto space = std::make_shared<ob::RealVectorStateSpace>(2);
    ob::RealVectorBounds bounds(2);
    for (unsigned k = 0; k < 2; ++k) {
        bounds.setLow(k, scene.low[k]);
        bounds.setHigh(k, scene.high[k]);
    }
    space->setBounds(bounds);
    auto information = std::make_shared<ob::SpaceInformation>(space);
    information->setStateValidityChecker([&cable](const ob::State *state) {
        dlo_shape shape;
        return cable.solve(place(state)[0], place(state)[1], shape) && cable.clear(shape);
    });
    information->setMotionValidator(std::make_shared<Leading>(information, cable));
    information->setup();

    ob::ScopedState<ob::RealVectorStateSpace> start(space), goal(space);
    for (unsigned k = 0; k < 2; ++k) {
        start[k] = scene.start[k];
        goal[k] = scene.goal[k];
    }
    auto problem = std::make_shared<ob::ProblemDefinition>(information);
    problem->setStartAndGoalStates(start, goal, 1e-3);
    problem->setOptimizationObjective(
        std::make_shared<ob::PathLengthOptimizationObjective>(information));
    auto planner = std::make_shared<og::RRTstar>(information);
    planner->setRange(0.15);
    planner->setGoalBias(0.1);
    planner->setProblemDefinition(problem);
    planner->setup();
    ob::IterationTerminationCondition iterations(static_cast<unsigned>(std::atoi(argv[3])));
    const ob::PlannerStatus status = planner->solve(iterations);
    std::cerr << "solver calls: " << cable.solves << "\n";
    if (status != ob::PlannerStatus::EXACT_SOLUTION) {
        std::cerr << "no path: " << status.asString() << "\n";
        return 1;
    }
    const auto *path = problem->getSolutionPath()->as<og::PathGeometric>();
    std::cerr << "path of the held end: " << path->length() << " m\n";
    for (std::size_t k = 1; k < path->getStateCount(); ++k) {
        const auto shapes = cable.lead(place(path->getState(static_cast<unsigned>(k - 1))),
                                       place(path->getState(static_cast<unsigned>(k))));
        if (shapes.empty()) {
            std::cerr << "the path is not valid\n";
            return 1;
        }
        for (const dlo_shape &shape : shapes) {
            for (int i = 0; i <= DLO_N; ++i)
                std::printf("%.6f %.6f ", shape.points[i][0], shape.points[i][1]);
            std::printf("%.6f\n", shape.min_bend_radius);
        }
    }
    return 0;
}
