// Collects a rollout of HalfCheetah-v5 or Hopper-v5 in one call: a prototype that is measured, not
// shipped. Each member has one environment, one policy (two hidden layers of 64, tanh) and its own
// running moments, as in `sauna.collect.host` with `envs=1`.
//
// Built with -ffp-contract=off: what numpy does in separate roundings is done so here, and rewards,
// moments and observations come out with the same bits. Only the policy's products use fused
// multiply-adds (and sum in another order than BLAS), and tanh is a rational function.

#include <mujoco/mujoco.h>

#include <cmath>
#include <cstdint>
#include <cstring>
#include <ctime>

namespace {
constexpr int kHidden = 64, kMost = 64;  // kMost: bound of observation and action sizes
constexpr double kEpsilon = 1e-8, kTau = 6.283185307179586;
}  // namespace

// Mirrored by `Fields` in measure.py. P members, S rows, D observation, A action, Q = nq + nv.
struct Stepper {
  int32_t members, rows, nq, nv, nu, frame_skip, limit;
  int32_t judged;           // states from the second on that must lie in a range; 0: never ends
  int32_t normal_velocity;  // how resets draw velocities: normal, or uniform
  int32_t given;            // actions are read instead of chosen
  int64_t reset_count;      // prepared resets per member
  double dt, forward_weight, control_cost, healthy_reward, speed_limit, reset_scale, clip;
  const mjModel** model;                     // [P]
  mjData** data;                             // [P]
  const float *low, *high;                   // [A]
  const double *healthy_low, *healthy_high;  // [judged]
  const double* initial;                     // [Q]
  const float *first, *second, *head;        // [P, D + 1, 64], [P, 65, 64], [P, 65, A]
  double *mean, *variance, *count;           // [P, D], [P, D], [P]
  double* seen;                              // [P, D] the current observation
  int64_t* length;                           // [P] steps of the running episode
  uint64_t* random;                          // [P]
  const double* resets;                      // [P, reset_count, Q], or null: drawn here
  int64_t* next_reset;                       // [P]
  float *observation, *action, *final_observation, *means;  // [P, S, D or A]; means may be null
  double *reward, *states;                                  // [P, S], [P, S, Q] or null
  uint8_t *terminated, *truncated;                          // [P, S]
};

namespace {

// Eigen's rational approximation, in a form that the compiler vectorises; libm's one by one would
// cost more than the rest of the policy.
inline float tanh_of(float x) {
  x = x > 7.90531110763549805f ? 7.90531110763549805f : x;
  x = x < -7.90531110763549805f ? -7.90531110763549805f : x;
  const float y = x * x;
  float p = -2.76076847742355e-16f;
  p = __builtin_fmaf(p, y, 2.00018790482477e-13f);
  p = __builtin_fmaf(p, y, -8.60467152213735e-11f);
  p = __builtin_fmaf(p, y, 5.12229709037114e-08f);
  p = __builtin_fmaf(p, y, 1.48572235717979e-05f);
  p = __builtin_fmaf(p, y, 6.37261928875436e-04f);
  p = __builtin_fmaf(p, y, 4.89352455891786e-03f);
  float q = 1.19825839466702e-06f;
  q = __builtin_fmaf(q, y, 1.18534705686654e-04f);
  q = __builtin_fmaf(q, y, 2.26843463243900e-03f);
  q = __builtin_fmaf(q, y, 4.89352518554385e-03f);
  return x * p / q;
}

// `out = tanh([x, 1] @ weight)`; the width is a constant so that the sums stay in registers.
void hidden_layer(const float* x, int size, const float* weight, float* out) {
  float sum[kHidden];
  std::memcpy(sum, weight + size * kHidden, sizeof sum);  // the biases
  for (int i = 0; i < size; ++i)
    for (int j = 0; j < kHidden; ++j)
      sum[j] = __builtin_fmaf(x[i], weight[i * kHidden + j], sum[j]);
  for (int j = 0; j < kHidden; ++j) out[j] = tanh_of(sum[j]);
}

void policy(const Stepper& s, int p, const float* x, float* mean) {
  const int size = s.nq - 1 + s.nv;
  float one[kHidden], two[kHidden];
  hidden_layer(x, size, s.first + int64_t(p) * (size + 1) * kHidden, one);
  hidden_layer(one, kHidden, s.second + int64_t(p) * (kHidden + 1) * kHidden, two);
  const float* head = s.head + int64_t(p) * (kHidden + 1) * s.nu;
  for (int a = 0; a < s.nu; ++a) mean[a] = head[kHidden * s.nu + a];
  for (int j = 0; j < kHidden; ++j)
    for (int a = 0; a < s.nu; ++a) mean[a] = __builtin_fmaf(two[j], head[j * s.nu + a], mean[a]);
}

void observe(const Stepper& s, const mjData* d, double* out) {
  for (int i = 1; i < s.nq; ++i) *out++ = d->qpos[i];
  for (int i = 0; i < s.nv; ++i) {
    const double faster = d->qvel[i] < -s.speed_limit ? -s.speed_limit : d->qvel[i];
    *out++ = faster > s.speed_limit ? s.speed_limit : faster;
  }
}

// Lets an observation enter the moments, in the order of `ObservationMoments.see`.
void enter(const Stepper& s, int p, const double* x) {
  const int size = s.nq - 1 + s.nv;
  double *mean = s.mean + p * size, *variance = s.variance + p * size;
  const double total = s.count[p] + 1.0;
  const double fraction = 1.0 / total, remains = s.count[p] / total;
  s.count[p] = total;
  for (int i = 0; i < size; ++i) {
    const double delta = x[i] - mean[i], move = delta * fraction;
    mean[i] += move;
    variance[i] = (variance[i] + delta * move) * remains;
  }
}

void normalize(const Stepper& s, int p, const double* x, float* out) {
  const int size = s.nq - 1 + s.nv;
  const double *mean = s.mean + p * size, *variance = s.variance + p * size;
  for (int i = 0; i < size; ++i) {
    double scaled = (x[i] - mean[i]) / std::sqrt(variance[i] + kEpsilon);
    scaled = scaled > s.clip ? s.clip : scaled;
    out[i] = float(scaled < -s.clip ? -s.clip : scaled);
  }
}

double uniform(uint64_t& state) {  // splitmix64
  uint64_t z = (state += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return double((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

double normal(uint64_t& state) {
  const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform(state)));
  return radius * std::cos(kTau * uniform(state));
}

void reset(const Stepper& s, int p) {
  const mjModel* m = s.model[p];
  mjData* d = s.data[p];
  const int size = s.nq + s.nv;
  double state[2 * kMost];
  if (s.resets) {
    const int64_t next = s.next_reset[p]++ % s.reset_count;
    std::memcpy(state, s.resets + (p * s.reset_count + next) * size, size * sizeof(double));
  } else {
    for (int i = 0; i < size; ++i) {
      const bool gaussian = i >= s.nq && s.normal_velocity;
      const double noise = gaussian ? normal(s.random[p]) : 2.0 * uniform(s.random[p]) - 1.0;
      state[i] = s.initial[i] + s.reset_scale * noise;
    }
  }
  mj_resetData(m, d);
  std::memcpy(d->qpos, state, s.nq * sizeof(double));
  std::memcpy(d->qvel, state + s.nq, s.nv * sizeof(double));
  mj_forward(m, d);
  s.length[p] = 0;
}

// The clipped action becomes the control; returns its cost, in float32 as Gymnasium computes it.
float control(const Stepper& s, int p, const float* action) {
  float squares = 0.0f;
  for (int a = 0; a < s.nu; ++a) {
    const float raised = action[a] < s.low[a] ? s.low[a] : action[a];
    const float clipped = raised > s.high[a] ? s.high[a] : raised;
    s.data[p]->ctrl[a] = clipped;
    squares += clipped * clipped;
  }
  return float(s.control_cost) * squares;
}

void physics(const Stepper& s, int p) {
  for (int k = 0; k < s.frame_skip; ++k) mj_step(s.model[p], s.data[p]);
}

bool healthy(const Stepper& s, const mjData* d) {
  for (int i = 0; i < s.judged; ++i) {
    const double x = i + 1 < s.nq ? d->qpos[i + 1] : d->qvel[i + 1 - s.nq];
    if (!(x > s.healthy_low[i] && x < s.healthy_high[i])) return false;
  }
  return true;
}

// One step of one member, into row `t`. False where a number is not finite.
bool step(const Stepper& s, int p, int t, const float* noise) {
  const int size = s.nq - 1 + s.nv;
  const int64_t at = int64_t(p) * s.rows + t;
  mjData* d = s.data[p];
  double *seen = s.seen + p * size, final_seen[2 * kMost];
  float *row = s.observation + at * size, *action = s.action + at * s.nu, mean[kMost];
  normalize(s, p, seen, row);
  policy(s, p, row, mean);
  if (!s.given)
    for (int a = 0; a < s.nu; ++a) action[a] = mean[a] + noise[a];
  if (s.means) std::memcpy(s.means + at * s.nu, mean, s.nu * sizeof(float));

  const float cost = control(s, p, action);
  const double before = d->qpos[0];
  physics(s, p);
  const bool well = healthy(s, d);
  const double forward = (d->qpos[0] - before) / s.dt * s.forward_weight;
  s.reward[at] = forward + well * s.healthy_reward - cost;
  ++s.length[p];
  s.terminated[at] = !well;
  s.truncated[at] = well && s.length[p] >= s.limit;
  const bool ended = s.terminated[at] || s.truncated[at];
  observe(s, d, ended ? final_seen : seen);
  if (ended) {
    reset(s, p);
    observe(s, d, seen);
  }
  enter(s, p, seen);
  if (ended) normalize(s, p, final_seen, s.final_observation + at * size);
  if (s.states) {
    std::memcpy(s.states + at * (s.nq + s.nv), d->qpos, s.nq * sizeof(double));
    std::memcpy(s.states + at * (s.nq + s.nv) + s.nq, d->qvel, s.nv * sizeof(double));
  }
  double sum = s.reward[at];
  for (int i = 0; i < size; ++i) sum += seen[i] + (ended ? final_seen[i] : 0.0);
  return std::isfinite(sum);
}

}  // namespace

extern "C" {

// Whether the library in memory is the one whose headers this was compiled with.
int same_version() { return mj_version() == mjVERSION_HEADER; }

// Rows `first` to `last` of the acting members, one member after the other: they share nothing.
// `noise` is `[last - first, P, A]`. Returns the member where a number was not finite, or -1.
int collect(const Stepper* s, const uint8_t* acting, const float* noise, int first, int last) {
  for (int p = 0; p < s->members; ++p)
    for (int t = first; t < last && acting[p]; ++t)
      if (!step(*s, p, t, noise + (int64_t(t - first) * s->members + p) * s->nu)) return p;
  return -1;
}

// Processor seconds of `mj_step` alone for the actions of the rows; resets are left out.
double raw(const Stepper* s, int rows) {
  std::clock_t spent = 0;
  for (int p = 0; p < s->members; ++p)
    for (int t = 0; t < rows;) {
      bool ended = false;
      const std::clock_t start = std::clock();
      for (; t < rows && !ended; ++t) {
        const int64_t at = int64_t(p) * s->rows + t;
        control(*s, p, s->action + at * s->nu);
        physics(*s, p);
        ended = s->terminated[at] || s->truncated[at];
      }
      spent += std::clock() - start;
      if (ended) reset(*s, p);
    }
  return double(spent) / CLOCKS_PER_SEC;
}
}
