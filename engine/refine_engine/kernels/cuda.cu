// CUDA kernels of the silhouette renderer; the specification is oracle.py. Compiled at run time by NVRTC.
//
// Two habits make every result the same bit for bit in every run on one card, without a sort:
//   * sums over faces that meet in a pixel or a vertex are fixed-point integers, whose addition has no order;
//   * a minimum carries its index in the low half of a 64-bit word, so that a tie goes to the lower index.
// No kernel uses shared memory or a barrier; a warp (LANES threads) takes one face of one view. Grids: x faces,
// pixels or vertices, y views. Names in capitals without a value here are defined by nvrtc.py, from the constants
// in Python that they share.

typedef unsigned long long Word;

static const unsigned FULL_WARP = 0xffffffffu;
static const float TINY = 1e-12f;
static const float LARGEST = 1048576.0f;  // of one face at one pixel: 2047 such faces fit into the signed sum

struct Triangle {
    float ax, ay, az, bx, by, bz, cx, cy, cz;  // pixels, depth
};

// False where the face is left out: a corner nearer than NEAR, or not finite.
static __device__ inline bool load(const float* screen, const int* corners, Triangle* t) {
    const float* a = screen + 3 * (size_t)corners[0];
    const float* b = screen + 3 * (size_t)corners[1];
    const float* c = screen + 3 * (size_t)corners[2];
    t->ax = a[0], t->ay = a[1], t->az = a[2];
    t->bx = b[0], t->by = b[1], t->bz = b[2];
    t->cx = c[0], t->cy = c[1], t->cz = c[2];
    const float sum = t->ax + t->ay + t->az + t->bx + t->by + t->bz + t->cx + t->cy + t->cz;
    return fminf(t->az, fminf(t->bz, t->cz)) > NEAR && isfinite(sum);
}

struct Box {
    int x, y, width, height;  // pixels; width or height at most 0: off the screen
};

// The pixels whose centres can be within `radius` of the triangle.
static __device__ inline Box reach(const Triangle& t, float radius, int width, int height) {
    const float left = floorf(fminf(t.ax, fminf(t.bx, t.cx)) - radius);
    const float right = floorf(fmaxf(t.ax, fmaxf(t.bx, t.cx)) + radius);
    const float top = floorf(fminf(t.ay, fminf(t.by, t.cy)) - radius);
    const float bottom = floorf(fmaxf(t.ay, fmaxf(t.by, t.cy)) + radius);
    Box box;  // clamped before the conversion: a coordinate may be far beyond the range of int
    box.x = (int)fminf(fmaxf(left, 0.0f), (float)width);
    box.y = (int)fminf(fmaxf(top, 0.0f), (float)height);
    box.width = (int)fmaxf(fminf(right, (float)(width - 1)), -1.0f) - box.x + 1;
    box.height = (int)fmaxf(fminf(bottom, (float)(height - 1)), -1.0f) - box.y + 1;
    return box;
}

static __device__ inline int area(const Box& box) {
    return box.width > 0 && box.height > 0 ? box.width * box.height : 0;
}

// +1 if the corners turn from +x to +y, -1 if the other way, 0 without an area: oracle.orientation.
static __device__ inline float orientation(const Triangle& t, float radius) {
    const float ux = t.bx - t.ax, uy = t.by - t.ay, vx = t.cx - t.bx, vy = t.cy - t.by;
    const float wx = t.ax - t.cx, wy = t.ay - t.cy;
    const float longest2 = fmaxf(ux * ux + uy * uy, fmaxf(vx * vx + vy * vy, wx * wx + wy * wy));
    const float area = ux * vy - uy * vx;
    const bool flat = !(fabsf(area) > FLAT * (longest2 + sqrtf(longest2) * radius));
    return flat ? 0.0f : copysignf(1.0f, area);
}

// The nearest point of the outline: squared distance, offset from it, weights of the corners.
struct Outline {
    float squared, qx, qy, wa, wb, wc;
    bool inside;
};

// One side of a triangle: where it starts, where it goes, 1 / its squared length.
struct Side {
    float x, y, ux, uy, inverse;
};

static __device__ inline Side side_of(float x, float y, float end_x, float end_y) {
    const float ux = end_x - x, uy = end_y - y;
    const Side side = {x, y, ux, uy, 1.0f / fmaxf(ux * ux + uy * uy, TINY)};
    return side;
}

struct Sides {
    Side ab, bc, ca;
    float turn;
};

static __device__ inline Sides sides_of(const Triangle& t, float radius) {
    const Sides sides = {
        side_of(t.ax, t.ay, t.bx, t.by), side_of(t.bx, t.by, t.cx, t.cy), side_of(t.cx, t.cy, t.ax, t.ay),
        orientation(t, radius)};
    return sides;
}

struct Foot {
    float squared, qx, qy, t, left;  // left: on which side of the line the point is
};

static __device__ inline Foot nearest_on_side(const Side& side, float px, float py) {
    const float dx = px - side.x, dy = py - side.y;
    Foot foot;
    foot.t = fminf(fmaxf((dx * side.ux + dy * side.uy) * side.inverse, 0.0f), 1.0f);
    foot.qx = dx - foot.t * side.ux, foot.qy = dy - foot.t * side.uy;
    foot.squared = foot.qx * foot.qx + foot.qy * foot.qy;
    foot.left = side.ux * dy - side.uy * dx;
    return foot;
}

static __device__ inline Outline nearest_on_outline(const Sides& sides, float px, float py) {
    const Foot u = nearest_on_side(sides.ab, px, py);
    const Foot v = nearest_on_side(sides.bc, px, py);
    const Foot w = nearest_on_side(sides.ca, px, py);
    Outline o = {u.squared, u.qx, u.qy, 1.0f - u.t, u.t, 0.0f, false};
    if (v.squared < o.squared) {
        o.squared = v.squared, o.qx = v.qx, o.qy = v.qy;
        o.wa = 0.0f, o.wb = 1.0f - v.t, o.wc = v.t;
    }
    if (w.squared < o.squared) {
        o.squared = w.squared, o.qx = w.qx, o.qy = w.qy;
        o.wa = w.t, o.wb = 0.0f, o.wc = 1.0f - w.t;
    }
    o.inside = fminf(sides.turn * u.left, fminf(sides.turn * v.left, sides.turn * w.left)) > 0.0f;
    return o;
}

static __device__ inline float warp_sum(float value) {
    for (int step = LANES / 2; step > 0; step /= 2) value += __shfl_xor_sync(FULL_WARP, value, step);
    return value;
}

static __device__ inline Word pack(float least, int index) {
    return ((Word)__float_as_uint(least) << 32) | (unsigned)index;  // bits of floats >= 0 sort as the floats do
}

static __device__ inline int face_of_warp() {
    return (blockIdx.x * blockDim.x + threadIdx.x) / LANES;
}

// Adds softplus(x_f(p)) of every face to `image` (B, side, side), fixed point, zeroed before.
extern "C" __global__ void optical_depth(
    const float* screen, const int* corners, int vertices, int faces, int side, float scale, float radius, Word* image) {
    const int face = face_of_warp(), view = blockIdx.y;
    Triangle t;
    if (face >= faces || !load(screen + 3 * (size_t)view * vertices, corners + 3 * (size_t)face, &t)) return;
    const Box box = reach(t, radius, side, side);
    const Sides sides = sides_of(t, radius);
    for (int i = threadIdx.x % LANES; i < area(box); i += LANES) {
        const int x = box.x + i % box.width, y = box.y + i / box.width;
        const Outline o = nearest_on_outline(sides, x + 0.5f, y + 0.5f);
        const float d2 = o.squared * scale;
        if (!o.inside && d2 >= CUTOFF) continue;
        const float depth = fminf(log1pf(expf(-d2)) + (o.inside ? d2 : 0.0f), LARGEST);
        const Word fixed = (Word)__float2ll_rn(depth * (float)(1ull << FRACTION_BITS));
        atomicAdd(image + ((size_t)view * side + y) * side + x, fixed);
    }
}

// dL/d(x, y) of the three corners of every face, written to `out` (B, F, 3, 2), from grad = dL/dS (B, side, side).
extern "C" __global__ void optical_depth_backward(
    const float* screen, const int* corners, int vertices, int faces, int side, float scale, float radius,
    const float* grad, float* out) {
    const int face = face_of_warp(), view = blockIdx.y, lane = threadIdx.x % LANES;
    if (face >= faces) return;
    Triangle t;
    const bool drawn = load(screen + 3 * (size_t)view * vertices, corners + 3 * (size_t)face, &t);
    const Box box = reach(t, radius, side, side);
    const Sides sides = sides_of(t, radius);
    const int pixels = drawn ? area(box) : 0;
    float ax = 0, ay = 0, bx = 0, by = 0, cx = 0, cy = 0;
    for (int i = lane; i < pixels; i += LANES) {
        const int x = box.x + i % box.width, y = box.y + i / box.width;
        const float g = grad[((size_t)view * side + y) * side + x];
        if (g == 0.0f) continue;
        const Outline o = nearest_on_outline(sides, x + 0.5f, y + 0.5f);
        const float d2 = o.squared * scale;
        if (!o.inside && d2 >= CUTOFF) continue;
        const float e = expf(-d2);  // dS/dx = sigmoid(x), dx/dcorner = -+ 2 q weight / s
        const float slope = (o.inside ? -2.0f : 2.0f * e) / (1.0f + e) * scale * g;
        const float sx = slope * o.qx, sy = slope * o.qy;
        ax += sx * o.wa, ay += sy * o.wa;
        bx += sx * o.wb, by += sy * o.wb;
        cx += sx * o.wc, cy += sy * o.wc;
    }
    ax = warp_sum(ax), ay = warp_sum(ay);
    bx = warp_sum(bx), by = warp_sum(by);
    cx = warp_sum(cx), cy = warp_sum(cy);
    if (lane != 0) return;
    float* mine = out + 6 * ((size_t)view * faces + face);
    mine[0] = ax, mine[1] = ay, mine[2] = bx, mine[3] = by, mine[4] = cx, mine[5] = cy;
}

// Sums the corners (B, F, 3, 2) that meet in each vertex, in the order of `incident`: out (B, V, 3), its z zero.
extern "C" __global__ void gather_corners(
    const float* corner_grad, const int* offsets, const int* incident, int vertices, int faces, float* out) {
    const int vertex = blockIdx.x * blockDim.x + threadIdx.x, view = blockIdx.y;
    if (vertex >= vertices) return;
    const float* of_view = corner_grad + 6 * (size_t)view * faces;
    float x = 0, y = 0;
    for (int k = offsets[vertex]; k < offsets[vertex + 1]; ++k) {
        x += of_view[2 * (size_t)incident[k]];
        y += of_view[2 * (size_t)incident[k] + 1];
    }
    float* mine = out + 3 * ((size_t)view * vertices + vertex);
    mine[0] = x, mine[1] = y, mine[2] = 0.0f;
}

struct Hit {
    float wa, wb, wc, depth;  // weights of the corners
    bool inside;
};

static __device__ inline Hit hit(const Triangle& t, bool orthographic, float px, float py) {
    const float turn = orientation(t, 0.0f);
    Hit h;
    h.wa = turn * ((t.cx - t.bx) * (py - t.by) - (t.cy - t.by) * (px - t.bx));
    h.wb = turn * ((t.ax - t.cx) * (py - t.cy) - (t.ay - t.cy) * (px - t.cx));
    h.wc = turn * ((t.bx - t.ax) * (py - t.ay) - (t.by - t.ay) * (px - t.ax));
    h.inside = turn != 0.0f && fminf(h.wa, fminf(h.wb, h.wc)) >= 0.0f;
    if (!orthographic) h.wa /= t.az, h.wb /= t.bz, h.wc /= t.cz;
    const float scale = 1.0f / (h.wa + h.wb + h.wc);
    h.wa *= scale, h.wb *= scale, h.wc *= scale;
    h.depth = h.wa * t.az + h.wb * t.bz + h.wc * t.cz;
    return h;
}

// Z-buffer (B, height, width) of packed depth and face, set to all ones before.
extern "C" __global__ void rasterize(
    const float* screen, const int* corners, int vertices, int faces, int orthographic, int height, int width,
    Word* nearest) {
    const int face = face_of_warp(), view = blockIdx.y;
    Triangle t;
    if (face >= faces || !load(screen + 3 * (size_t)view * vertices, corners + 3 * (size_t)face, &t)) return;
    const Box box = reach(t, 0.0f, width, height);
    for (int i = threadIdx.x % LANES; i < area(box); i += LANES) {
        const int x = box.x + i % box.width, y = box.y + i / box.width;
        const Hit h = hit(t, orthographic, x + 0.5f, y + 0.5f);
        if (h.inside) atomicMin(nearest + ((size_t)view * height + y) * width + x, pack(h.depth, face));
    }
}

// Unpacks the z-buffer: face (B, height, width), -1 = background, and its weights (B, height, width, 3).
extern "C" __global__ void resolve(
    const float* screen, const int* corners, int vertices, int orthographic, int height, int width,
    const Word* nearest, long long* face_image, float* weight_image) {
    const int pixel = blockIdx.x * blockDim.x + threadIdx.x, view = blockIdx.y;
    if (pixel >= height * width) return;
    const size_t at = (size_t)view * height * width + pixel;
    const bool covered = nearest[at] != ~0ull;
    const unsigned face = (unsigned)nearest[at];
    Hit h = {0, 0, 0, 0, false};
    if (covered) {
        Triangle t;
        load(screen + 3 * (size_t)view * vertices, corners + 3 * (size_t)face, &t);
        h = hit(t, orthographic, pixel % width + 0.5f, pixel / width + 0.5f);
    }
    face_image[at] = covered ? (long long)face : -1;
    weight_image[3 * at] = h.wa, weight_image[3 * at + 1] = h.wb, weight_image[3 * at + 2] = h.wc;
}

// sigma (flip(alpha) - alpha')^2 + cost ln(1 / sigma) at every pixel of the view pairs (B, side, side), and its
// derivatives: of both optical depths (B, side, side), and of the confidence (V,), fixed point, zeroed before.
extern "C" __global__ void image_symmetry(
    const float* seen, const float* mirrored, const long long* face_image, const float* weight_image,
    const int* corners, const float* confidence, float cost, float fixed_one, int side,
    float* value, float* d_seen, float* d_mirrored, Word* d_confidence) {
    const int pixel = blockIdx.x * blockDim.x + threadIdx.x, view = blockIdx.y;
    if (pixel >= side * side) return;
    const size_t at = (size_t)view * side * side + pixel;
    const size_t flipped = at + side - 1 - 2 * (pixel % side);
    const long long face = face_image[at];
    if (face < 0) {
        value[at] = d_mirrored[at] = d_seen[flipped] = 0.0f;
        return;
    }
    const int* corner = corners + 3 * face;
    const float* weight = weight_image + 3 * at;
    const float sigma =
        weight[0] * confidence[corner[0]] + weight[1] * confidence[corner[1]] + weight[2] * confidence[corner[2]];
    const float clear = expf(-seen[flipped]), clear_mirrored = expf(-mirrored[at]);
    const float difference = clear_mirrored - clear;  // flip(alpha) - alpha'
    value[at] = sigma * difference * difference - cost * logf(fmaxf(sigma, LEAST_CONFIDENCE));
    d_seen[flipped] = 2.0f * sigma * difference * clear;
    d_mirrored[at] = -2.0f * sigma * difference * clear_mirrored;
    const float d_sigma = difference * difference - (sigma >= LEAST_CONFIDENCE ? cost / sigma : 0.0f);
    for (int k = 0; k < 3; ++k)
        atomicAdd(d_confidence + corner[k], (Word)__float2ll_rn(weight[k] * d_sigma * fixed_one));
}

// Packed squared distance and index of the point nearest to each query: best (V,), all ones before. As many of both.
// Grid: x queries, y runs of `run` candidates. A thread loads each candidate once for QUERIES queries.
extern "C" __global__ void nearest_point(
    const float* points, const float* queries, int count, int run, Word* best) {
    const int first = blockIdx.x * blockDim.x * QUERIES + threadIdx.x;
    float x[QUERIES], y[QUERIES], z[QUERIES], least[QUERIES];
    int index[QUERIES];
#pragma unroll
    for (int k = 0; k < QUERIES; ++k) {
        const float* query = queries + 3 * (size_t)min(first + k * (int)blockDim.x, count - 1);
        x[k] = query[0], y[k] = query[1], z[k] = query[2];
        least[k] = 3e38f;
        index[k] = 0;
    }
    const int begin = blockIdx.y * run, end = min(begin + run, count);
    for (int u = begin; u < end; ++u) {
        const float ux = points[3 * (size_t)u], uy = points[3 * (size_t)u + 1], uz = points[3 * (size_t)u + 2];
#pragma unroll
        for (int k = 0; k < QUERIES; ++k) {
            const float dx = x[k] - ux, dy = y[k] - uy, dz = z[k] - uz;
            const float squared = dx * dx + dy * dy + dz * dz;
            index[k] = squared < least[k] ? u : index[k];
            least[k] = fminf(squared, least[k]);
        }
    }
#pragma unroll
    for (int k = 0; k < QUERIES; ++k) {
        const int query = first + k * (int)blockDim.x;
        if (query < count) atomicMin(best + query, pack(least[k], index[k]));
    }
}
