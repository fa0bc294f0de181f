// The planar bundle adjustment of tests/bench/solver.py in Ceres (http://ceres-solver.org), with analytic derivatives.
//
// planar PROBLEM SOLVER ITERATIONS TOLERANCE: reads a problem, solves it once on one thread with "sparse" or "dense" Schur
// elimination of the points, and prints for every iteration its cost and the CPU seconds spent until its end (structure
// analysis included, building the problem not).

#include <ceres/ceres.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <memory>
#include <vector>

namespace {

struct Sighting final : ceres::SizedCostFunction<2, 3, 3> {
  // pose x, y, heading and point; R takes robot axes to camera axes, pixels over sigma
  const double *camera;
  double u, v;

  Sighting(const double *camera_, double u_, double v_) : camera(camera_), u(u_), v(v_) {}

  bool Evaluate(double const *const *x, double *e, double **J) const override {
    const double *R = camera, *t = camera + 9;
    const double fx = camera[12], fy = camera[13], cx = camera[14], cy = camera[15];
    const double c = std::cos(x[0][2]), s = std::sin(x[0][2]);
    const double ox = x[1][0] - x[0][0], oy = x[1][1] - x[0][1];
    const double r[3] = {c * ox + s * oy - t[0], -s * ox + c * oy - t[1], x[1][2] - t[2]};
    const double px = R[0] * r[0] + R[1] * r[1] + R[2] * r[2];
    const double py = R[3] * r[0] + R[4] * r[1] + R[5] * r[2];
    const double pz = R[6] * r[0] + R[7] * r[1] + R[8] * r[2];
    if (!(pz > 1e-9 && r[0] * r[0] + r[1] * r[1] + r[2] * r[2] > 0.01)) {  // behind the camera or inside it
      e[0] = e[1] = 1e4;
      if (J && J[0]) std::fill(J[0], J[0] + 6, 0.0);
      if (J && J[1]) std::fill(J[1], J[1] + 6, 0.0);
      return true;
    }
    const double inverse = 1.0 / pz, a = px * inverse, b = py * inverse;
    e[0] = fx * a + cx - u;
    e[1] = fy * b + cy - v;
    if (!J) return true;
    double B[2][3];
    for (int k = 0; k < 3; ++k) {
      const double by_u = fx * inverse * (R[k] - a * R[6 + k]), by_v = fy * inverse * (R[3 + k] - b * R[6 + k]);
      B[0][k] = by_u;
      B[1][k] = by_v;
    }
    for (int i = 0; i < 2; ++i) {
      const double wx = B[i][0] * c - B[i][1] * s, wy = B[i][0] * s + B[i][1] * c;
      if (J[0]) {
        J[0][3 * i] = -wx;
        J[0][3 * i + 1] = -wy;
        J[0][3 * i + 2] = wx * oy - wy * ox;
      }
      if (J[1]) {
        J[1][3 * i] = wx;
        J[1][3 * i + 1] = wy;
        J[1][3 * i + 2] = B[i][2];
      }
    }
    return true;
  }
};

struct Move final : ceres::SizedCostFunction<3, 3, 3> {
  const double *z, *L;

  explicit Move(const double *move) : z(move), L(move + 3) {}

  bool Evaluate(double const *const *x, double *e, double **J) const override {
    const double c = std::cos(x[0][2]), s = std::sin(x[0][2]);
    const double dx = x[1][0] - x[0][0], dy = x[1][1] - x[0][1];
    const double shift[2] = {c * dx + s * dy, -s * dx + c * dy};
    const double turn = std::remainder(x[1][2] - x[0][2] - z[2], 2.0 * M_PI);
    const double r[3] = {shift[0] - z[0], shift[1] - z[1], turn};
    const double D[2][3][3] = {{{-c, -s, shift[1]}, {s, -c, -shift[0]}, {0, 0, -1}}, {{c, s, 0}, {-s, c, 0}, {0, 0, 1}}};
    for (int i = 0; i < 3; ++i) {
      e[i] = L[3 * i] * r[0] + L[3 * i + 1] * r[1] + L[3 * i + 2] * r[2];
      for (int side = 0; J && side < 2; ++side)
        for (int k = 0; J[side] && k < 3; ++k)
          J[side][3 * i + k] = L[3 * i] * D[side][0][k] + L[3 * i + 1] * D[side][1][k] + L[3 * i + 2] * D[side][2][k];
    }
    return true;
  }
};

double cpu();

struct Clock final : ceres::IterationCallback {
  double begun = 0.0;
  std::vector<double> seconds;

  ceres::CallbackReturnType operator()(const ceres::IterationSummary &) override {
    seconds.push_back(cpu() - begun);
    return ceres::SOLVER_CONTINUE;
  }
};

double cpu() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

}  // namespace

int main(int argc, char **argv) {
  if (argc != 5) return 2;
  std::FILE *file = std::fopen(argv[1], "rb");
  if (!file) return 2;
  std::int64_t n[5];  // stops, labels, sightings, moves, cameras
  auto read = [&](void *to, std::size_t size) { return std::fread(to, 1, size, file) == size; };
  if (!read(n, sizeof n)) return 2;
  std::vector<double> poses(3 * n[0]), points(3 * n[1]), sightings(2 * n[2]), moves(12 * n[3]), cameras(16 * n[4]);
  std::vector<std::int64_t> index(3 * n[2]), ends(2 * n[3]);
  for (auto *v : {&poses, &points, &sightings, &moves, &cameras})
    if (!read(v->data(), v->size() * sizeof(double))) return 2;
  for (auto *v : {&index, &ends})
    if (!read(v->data(), v->size() * sizeof(std::int64_t))) return 2;
  std::fclose(file);

  ceres::Problem problem;
  auto *ordering = new ceres::ParameterBlockOrdering;
  for (std::int64_t i = 0; i < n[2]; ++i) {
    const std::int64_t stop = index[3 * i], camera = index[3 * i + 1], label = index[3 * i + 2];
    problem.AddResidualBlock(new Sighting(&cameras[16 * camera], sightings[2 * i], sightings[2 * i + 1]), nullptr,
                             &poses[3 * stop], &points[3 * label]);
    ordering->AddElementToGroup(&points[3 * label], 0);
    ordering->AddElementToGroup(&poses[3 * stop], 1);
  }
  for (std::int64_t i = 0; i < n[3]; ++i) {
    problem.AddResidualBlock(new Move(&moves[12 * i]), nullptr, &poses[3 * ends[2 * i]], &poses[3 * ends[2 * i + 1]]);
    ordering->AddElementToGroup(&poses[3 * ends[2 * i]], 1);
    ordering->AddElementToGroup(&poses[3 * ends[2 * i + 1]], 1);
  }
  problem.SetParameterBlockConstant(&poses[0]);
  ceres::Solver::Options options;
  options.linear_solver_type = std::strcmp(argv[2], "dense") ? ceres::SPARSE_SCHUR : ceres::DENSE_SCHUR;
  options.linear_solver_ordering.reset(ordering);
  options.num_threads = 1;
  options.max_num_iterations = std::atoi(argv[3]);
  options.function_tolerance = std::atof(argv[4]);
  options.gradient_tolerance = options.parameter_tolerance = 1e-16;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  Clock clock;
  options.callbacks.push_back(&clock);
  clock.begun = cpu();
  ceres::Solve(options, &problem, &summary);
  for (std::size_t i = 0; i < clock.seconds.size() && i < summary.iterations.size(); ++i)
    std::printf("%.17g %.9g\n", summary.iterations[i].cost, clock.seconds[i]);
  return 0;
}
