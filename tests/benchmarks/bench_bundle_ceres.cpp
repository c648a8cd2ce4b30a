// Ceres on the data of bench_bundle.py: angle-axis, translation, focal length and k1 of each camera, free points.
// Build: g++ -O3 -march=native -I/usr/include/eigen3 bench_bundle_ceres.cpp -lceres -lglog -o bench_bundle_ceres
// Run: bench_bundle_ceres DATA TOLERANCE ROUNDS; prints a line "form threads clock_ms processor_ms iterations cost".
#include <ceres/ceres.h>
#include <ceres/rotation.h>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>
using std::vector;

struct Automatic {
  double u, v, cx, cy, w;
  template <class T> bool operator()(const T* c, const T* X, T* r) const {
    T p[3];
    ceres::AngleAxisRotatePoint(c, X, p);
    T z = T(1) / (p[2] + c[5]), x = (p[0] + c[3]) * z, y = (p[1] + c[4]) * z, d = T(1) + (x * x + y * y) * c[7];
    r[0] = T(w) * (c[6] * x * d + T(cx - u));
    r[1] = T(w) * (c[6] * y * d + T(cy - v));
    return true;
  }
};

struct Analytic : ceres::SizedCostFunction<2, 8, 3> {
  double u, v, cx, cy, w;
  Analytic(double u, double v, double cx, double cy, double w) : u(u), v(v), cx(cx), cy(cy), w(w) {}
  bool Evaluate(double const* const* at, double* r, double** J) const override {
    const double *c = at[0], *X = at[1];
    double R[9];  // column by column
    ceres::AngleAxisToRotationMatrix(c, R);
    double p[3];
    for (int i = 0; i < 3; i++) p[i] = R[i] * X[0] + R[3 + i] * X[1] + R[6 + i] * X[2];
    double z = 1 / (p[2] + c[5]), x = (p[0] + c[3]) * z, y = (p[1] + c[4]) * z;
    double r2 = x * x + y * y, d = 1 + r2 * c[7], f = c[6];
    r[0] = w * (f * x * d + cx - u);
    r[1] = w * (f * y * d + cy - v);
    if (!J) return true;
    double a = d + 2 * c[7] * x * x, b = 2 * c[7] * x * y, e = d + 2 * c[7] * y * y, g = w * f * z;
    double A[2][3] = {{g * a, g * b, -g * (a * x + b * y)}, {g * b, g * e, -g * (b * x + e * y)}};
    if (J[0]) {
      double t2 = c[0] * c[0] + c[1] * c[1] + c[2] * c[2], t = std::sqrt(t2);
      double k1 = t > 1e-8 ? (1 - std::cos(t)) / t2 : 0.5, k2 = t > 1e-8 ? (t - std::sin(t)) / (t2 * t) : 1.0 / 6;
      double K[3][3] = {{0, -c[2], c[1]}, {c[2], 0, -c[0]}, {-c[1], c[0], 0}}, L[3][3];
      for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) {
          double s = 0;
          for (int n = 0; n < 3; n++) s += K[i][n] * K[n][k];
          L[i][k] = (i == k) + k1 * K[i][k] + k2 * s;
        }
      for (int i = 0; i < 2; i++) {
        double q[3] = {p[1] * A[i][2] - p[2] * A[i][1], p[2] * A[i][0] - p[0] * A[i][2], p[0] * A[i][1] - p[1] * A[i][0]};
        for (int k = 0; k < 3; k++) {
          J[0][8 * i + k] = q[0] * L[0][k] + q[1] * L[1][k] + q[2] * L[2][k];
          J[0][8 * i + 3 + k] = A[i][k];
        }
        double s = i ? y : x;
        J[0][8 * i + 6] = w * s * d;
        J[0][8 * i + 7] = w * f * s * r2;
      }
    }
    if (J[1])
      for (int i = 0; i < 2; i++)
        for (int k = 0; k < 3; k++)
          J[1][3 * i + k] = A[i][0] * R[3 * k] + A[i][1] * R[3 * k + 1] + A[i][2] * R[3 * k + 2];
    return true;
  }
};

int main(int argc, char** argv) {
  if (argc != 4) return 2;
  FILE* file = fopen(argv[1], "rb");
  int64_t h[3];
  if (!file || fread(h, 8, 3, file) != 3) return 2;
  int64_t C = h[0], P = h[1], M = h[2];
  vector<double> cameras(8 * C), centre(2 * C), points(3 * P), pixels(2 * M);
  vector<int64_t> ci(M), pi(M);
  double w;
  size_t n = fread(cameras.data(), 8, 8 * C, file) + fread(centre.data(), 8, 2 * C, file) +
             fread(points.data(), 8, 3 * P, file) + fread(ci.data(), 8, M, file) + fread(pi.data(), 8, M, file) +
             fread(pixels.data(), 8, 2 * M, file) + fread(&w, 8, 1, file);
  if (n != size_t(10 * C + 3 * P + 4 * M + 1)) return 2;
  double tolerance = atof(argv[2]);
  int rounds = atoi(argv[3]);
  for (int form = 0; form < 2; form++)
    for (int threads = 1; threads <= 2; threads++) {
      double best = 1e300, processor = 1e300, cost = 0;
      int iterations = 0;
      for (int round = 0; round < rounds; round++) {
        vector<double> c = cameras, x = points;
        auto start = std::chrono::steady_clock::now();
        clock_t began = clock();
        ceres::Problem problem;
        auto* order = new ceres::ParameterBlockOrdering;
        for (int64_t m = 0; m < M; m++) {
          double u = pixels[2 * m], v = pixels[2 * m + 1], cx = centre[2 * ci[m]], cy = centre[2 * ci[m] + 1];
          ceres::CostFunction* f =
              form ? (ceres::CostFunction*)new Analytic(u, v, cx, cy, w)
                   : new ceres::AutoDiffCostFunction<Automatic, 2, 8, 3>(new Automatic{u, v, cx, cy, w});
          problem.AddResidualBlock(f, nullptr, &c[8 * ci[m]], &x[3 * pi[m]]);
        }
        for (int64_t p = 0; p < P; p++) order->AddElementToGroup(&x[3 * p], 0);
        for (int64_t k = 0; k < C; k++) order->AddElementToGroup(&c[8 * k], 1);
        ceres::Solver::Options options;
        options.linear_solver_type = ceres::DENSE_SCHUR;
        options.linear_solver_ordering.reset(order);
        options.function_tolerance = tolerance;
        options.gradient_tolerance = options.parameter_tolerance = 1e-16;
        options.max_num_iterations = 100;
        options.num_threads = threads;
        options.logging_type = ceres::SILENT;
        ceres::Solver::Summary summary;
        ceres::Solve(options, &problem, &summary);
        std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - start;
        best = std::min(best, took.count());
        processor = std::min(processor, 1e3 * double(clock() - began) / CLOCKS_PER_SEC);
        cost = 2 * summary.final_cost;
        iterations = int(summary.iterations.size()) - 1;
      }
      printf("%s %d %.3f %.3f %d %.9f\n", form ? "analytic" : "autodiff", threads, best, processor, iterations, cost);
      fflush(stdout);
    }
}
