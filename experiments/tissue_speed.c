/* What tissue_speed compares the walk with: plane layers, one ray after another, in scalar C.

   `mcml` does what MCML does for every photon packet (Wang, Jacques and Zheng 1995): hop, drop,
   spin in three dimensions in double precision, absorption by weight, roulette at 1e-4 with one
   chance in ten, Fresnel reflection of all or none. Nothing is scored on grids.
   `reduced` is the walk of hylios_fit.tissue: depth in mean free paths and cosine, in single
   precision, absorbed whole. It knows interfaces at the top and the bottom only.

   tissue_speed mcml|reduced RAYS SEED ABOVE BELOW {THICKNESS INDEX MU_A MU_S G} ...
   prints: seconds, interactions, then for the light out of the top, out of the bottom and absorbed
   in each layer the sum and the sum of squares over the rays that entered. */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MOST 16
static int layers;
static double edge[MOST + 1], n[MOST + 2], mu_a[MOST], mu_s[MOST], g[MOST];
static double sum[MOST + 2], squares[MOST + 2];
static uint64_t interactions;

static uint64_t s[4];
static inline uint64_t rotl(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }
static inline uint64_t word(void) { /* xoshiro256+, Blackman and Vigna 2018 */
    uint64_t out = s[0] + s[3], t = s[1] << 17;
    s[2] ^= s[0]; s[3] ^= s[1]; s[1] ^= s[2]; s[0] ^= s[3]; s[2] ^= t; s[3] = rotl(s[3], 45);
    return out;
}
static inline double uniform(void) { return ((double)(word() >> 11) + 0.5) * 0x1p-53; }
static inline float uniformf(void) { return ((float)(word() >> 40) + 0.5f) * 0x1p-24f; }

static double fresnel(double n1, double n2, double c, double *ct) {
    double sin2 = n1 / n2 * (n1 / n2) * (1 - c * c);
    if (sin2 >= 1) { *ct = 0; return 1; }
    *ct = sqrt(1 - sin2);
    double rs = (n1 * c - n2 * *ct) / (n1 * c + n2 * *ct);
    double rp = (n2 * c - n1 * *ct) / (n2 * c + n1 * *ct);
    return 0.5 * (rs * rs + rp * rp);
}

static void mcml(double *ends) {
    double x = 0, y = 0, z = 0, ux = 0, uy = 0, uz = 1, w = 1, left = 0;
    int layer = 0;
    while (w > 0) {
        double mu_t = mu_a[layer] + mu_s[layer];
        if (left == 0) left = -log(uniform());
        double step = left / mu_t, room = INFINITY;
        if (uz > 0) room = (edge[layer + 1] - z) / uz;
        else if (uz < 0) room = (edge[layer] - z) / uz;
        if (step > room) {
            double ct;
            int next = uz > 0 ? layer + 1 : layer - 1;
            x += room * ux; y += room * uy; z += room * uz;
            left -= room * mu_t;
            double r = fresnel(n[layer + 1], n[next + 1], fabs(uz), &ct);
            if (uniform() <= r) uz = -uz;
            else if (next < 0) { ends[0] += w; return; }
            else if (next == layers) { ends[1] += w; return; }
            else {
                double ratio = n[layer + 1] / n[next + 1];
                ux *= ratio; uy *= ratio; uz = uz > 0 ? ct : -ct;
                layer = next;
            }
            continue;
        }
        x += step * ux; y += step * uy; z += step * uz;
        left = 0;
        interactions++;
        double lost = w * mu_a[layer] / mu_t;
        w -= lost;
        ends[2 + layer] += lost;
        double c, a = g[layer];
        if (a == 0) c = 2 * uniform() - 1;
        else {
            double t = (1 - a * a) / (1 - a + 2 * a * uniform());
            c = (1 + a * a - t * t) / (2 * a);
        }
        double sine = sqrt(1 - c * c), phi = 2 * M_PI * uniform();
        double cp = cos(phi), sp = phi < M_PI ? sqrt(1 - cp * cp) : -sqrt(1 - cp * cp);
        if (fabs(uz) > 1 - 1e-12) {
            ux = sine * cp; uy = sine * sp; uz = uz > 0 ? c : -c;
        } else {
            double root = sqrt(1 - uz * uz), vx = ux, vy = uy;
            ux = sine * (vx * uz * cp - vy * sp) / root + vx * c;
            uy = sine * (vy * uz * cp + vx * sp) / root + vy * c;
            uz = -sine * cp * root + uz * c;
        }
        if (w < 1e-4) {
            if (uniform() < 0.1) w *= 10;
            else w = 0;
        }
    }
    if (x + y == 1e300) puts(""); /* sideways positions are not to be optimised away */
}

static float depth_of[MOST + 1], albedo[MOST];
static void reduced(double *ends) {
    float z = 0, uz = 1, bottom = depth_of[layers];
    for (;;) {
        z -= logf(uniformf()) * uz;
        if (z <= 0 || z >= bottom) {
            int up = z <= 0;
            double ct;
            if (uniformf() > fresnel(n[1], up ? n[0] : n[layers + 1], fabsf(uz), &ct)) {
                ends[up ? 0 : 1] = 1;
                return;
            }
            uz = -uz;
            z = up ? 0 : bottom;
            continue;
        }
        int layer = 0;
        while (layer < layers - 1 && z >= depth_of[layer + 1]) layer++;
        interactions++;
        float u = uniformf();
        if (u > albedo[layer]) { ends[2 + layer] = 1; return; }
        float xi = u / albedo[layer], rest = 1 - xi, a = 1 - (float)g[layer];
        float root = a + 2 * (float)g[layer] * rest;
        float bend = 2 * a * a * xi * (1 + (float)g[layer] * rest) / (root * root);
        float across = sqrtf(fmaxf((1 - uz * uz) * bend * (2 - bend), 0));
        uz = uz - uz * bend + across * cosf((float)M_PI * uniformf());
        uz = fminf(fmaxf(uz, -1), 1);
    }
}

int main(int count, char **argument) {
    if (count < 11 || (count - 6) % 5 || (count - 6) / 5 > MOST) return 2;
    void (*walk)(double *) = strcmp(argument[1], "mcml") ? reduced : mcml;
    long rays = atol(argument[2]);
    uint64_t x = strtoull(argument[3], NULL, 10);
    for (int i = 0; i < 4; i++) { /* splitmix64 */
        uint64_t z = (x += 0x9e3779b97f4a7c15u);
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
        s[i] = z ^ (z >> 31);
    }
    layers = (count - 6) / 5;
    n[0] = atof(argument[4]);
    for (int i = 0; i < layers; i++) {
        char **of = argument + 6 + 5 * i;
        edge[i + 1] = edge[i] + atof(of[0]);
        n[i + 1] = atof(of[1]); mu_a[i] = atof(of[2]); mu_s[i] = atof(of[3]); g[i] = atof(of[4]);
        depth_of[i + 1] = depth_of[i] + (float)(atof(of[0]) * (mu_a[i] + mu_s[i]));
        albedo[i] = (float)(mu_s[i] / (mu_a[i] + mu_s[i]));
    }
    n[layers + 1] = atof(argument[5]);
    clock_t start = clock();
    for (long i = 0; i < rays; i++) {
        double ends[MOST + 2] = {0};
        walk(ends);
        for (int j = 0; j < layers + 2; j++) {
            sum[j] += ends[j];
            squares[j] += ends[j] * ends[j];
        }
    }
    printf("%.6f %llu", (double)(clock() - start) / CLOCKS_PER_SEC,
           (unsigned long long)interactions);
    for (int j = 0; j < layers + 2; j++) printf(" %.17g %.17g", sum[j], squares[j]);
    puts("");
    return 0;
}
