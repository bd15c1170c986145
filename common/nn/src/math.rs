//! Element-wise functions that the compiler can vectorise, and the dispatch that lets it.
//!
//! The stock build targets any x86-64. [`vectorized!`](crate::vectorized) declares functions that are compiled
//! once for each instruction set that faer's `pulp` knows, the best of which is picked at run time. Every one gives
//! the same bits: what rounds once here (`mul_add`) rounds once everywhere, if slowly where the processor cannot.

use std::sync::LazyLock;

static ARCH: LazyLock<pulp::Arch> = LazyLock::new(pulp::Arch::new);

/// Declares a function whose body is compiled for every instruction set.
///
/// A closure would not do: it is compiled for the base instruction set unless the compiler happens to inline
/// it. What the body calls must be `#[inline(always)]` for the same reason.
#[macro_export]
macro_rules! vectorized {
    (
        $(#[$attribute:meta])*
        $visibility:vis fn $name:ident $(<$($lifetime:lifetime),+>)? (
            $($argument:ident: $kind:ty),+ $(,)?
        ) $(-> $output:ty)? $body:block
    ) => {
        $(#[$attribute])*
        $visibility fn $name $(<$($lifetime),+>)? ($($argument: $kind),+) $(-> $output)? {
            struct Body $(<$($lifetime),+>)? { $($argument: $kind),+ }
            impl $(<$($lifetime),+>)? $crate::math::Kernel for Body $(<$($lifetime),+>)? {
                #[allow(unused_parens, reason = "a type or none")]
                type Output = ($($output)?);

                #[inline(always)]
                #[allow(unused_mut, reason = "arguments are taken as the body wants them")]
                fn run(self) -> Self::Output {
                    let Self { $(mut $argument),+ } = self;
                    $body
                }
            }
            $crate::math::dispatch(Body { $($argument),+ })
        }
    };
}

/// What [`vectorized!`](crate::vectorized) makes of a function.
pub trait Kernel {
    /// What it returns.
    type Output;

    /// Does it; `#[inline(always)]`.
    fn run(self) -> Self::Output;
}

/// Runs a kernel as compiled for the best instruction set of this machine.
#[inline]
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    struct Op<K>(K);

    impl<K: Kernel> pulp::WithSimd for Op<K> {
        type Output = K::Output;

        #[inline(always)]
        fn with_simd<S: pulp::Simd>(self, _: S) -> K::Output {
            self.0.run()
        }
    }

    ARCH.dispatch(Op(kernel))
}

/// Adding and subtracting 1.5 · 2²³ rounds to an integer, which then stands in the low bits.
const ROUND: f32 = 12_582_912.0;

/// e^x with a relative error below 3e-7 for x in [−87, 88]; saturates outside.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // x = n ln 2 + r with |r| <= ln 2 / 2; e^x = 2^n e^r, e^r by its Taylor polynomial.
    let x = x.clamp(-87.0, 88.0);
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    // ln 2 in two parts, the first exact in few bits, so that r keeps its precision.
    let r = n.mul_add(2.121_944_4e-4, n.mul_add(-0.693_359_4, x));
    // Two short chains instead of a long one: the functions built on this wait for it.
    let (low, high) = (r.mul_add(1.0 / 6.0, 0.5), r.mul_add(1.0 / 120.0, 1.0 / 24.0));
    let rr = r * r;
    let p = rr.mul_add(1.0 / 720.0, high);
    let p = rr.mul_add(rr.mul_add(p, low), r) + 1.0;
    // n lies in [-126, 127], so the exponent stays in range.
    let exponent = (shifted.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
    p * f32::from_bits(((exponent + 127) << 23) as u32)
}

/// ln x with an error of about 1e-7, relative or absolute, for positive normal x.
#[inline(always)]
pub fn ln(x: f32) -> f32 {
    // x = 2^n m with m in [√½, √2): its bits less those of √½ have n where an exponent is.
    let bits = x.to_bits() as i32 - std::f32::consts::FRAC_1_SQRT_2.to_bits() as i32;
    let n = (bits >> 23) as f32;
    let m = f32::from_bits(((bits & 0x7f_ffff) + std::f32::consts::FRAC_1_SQRT_2.to_bits() as i32) as u32);
    // ln (1 + r) = r − r²/2 + r³ P(r), P fitted (Cephes).
    let r = m - 1.0;
    let rr = r * r;
    let p = 7.037_683_6e-2_f32.mul_add(r, -1.151_461e-1);
    let p = p.mul_add(r, 1.167_699_9e-1).mul_add(r, -1.242_014_1e-1).mul_add(r, 1.424_932_3e-1);
    let p = p.mul_add(r, -1.666_805_8e-1).mul_add(r, 2.000_071_5e-1).mul_add(r, -2.499_999_4e-1);
    let p = p.mul_add(r, 3.333_333e-1) * r * rr;
    // ln 2 in two parts, the first exact in few bits.
    n.mul_add(0.693_359_4, r + (-0.5_f32).mul_add(rr, n.mul_add(-2.121_944_4e-4, p)))
}

/// sin 2πv and cos 2πv with an absolute error of about 1e-7, for v in [0, 1].
#[inline(always)]
pub fn sin_cos_of_turns(v: f32) -> (f32, f32) {
    // v = quarter / 4 + rest, the rest within an eighth of a turn; both polynomials are Cephes's.
    let shifted = v.mul_add(4.0, ROUND);
    let quarter = shifted.to_bits();
    let x = v.mul_add(4.0, ROUND - shifted) * std::f32::consts::FRAC_PI_2;
    let xx = x * x;
    let p = (-1.951_529_6e-4_f32).mul_add(xx, 8.332_161e-3).mul_add(xx, -1.666_665_5e-1);
    let sin = p.mul_add(xx * x, x);
    let p = 2.443_315_7e-5_f32.mul_add(xx, -1.388_731_6e-3).mul_add(xx, 4.166_664_6e-2);
    let cos = p.mul_add(xx * xx, (-0.5_f32).mul_add(xx, 1.0));
    let (s, c) = if quarter & 1 == 0 { (sin, cos) } else { (cos, sin) };
    (if quarter & 2 == 0 { s } else { -s }, if (quarter + 1) & 2 == 0 { c } else { -c })
}

/// A softmax's e^x, x less the largest: exactly zero where it is less than 1e-20 of the largest, for x = −∞ too.
///
/// So small a share counts for nothing in a sum, but its gradients are so small that their products become subnormal, and
/// arithmetic with subnormal numbers takes a hundred times as long on some processors: trained networks, which are sure
/// of where to look, took three times as long as fresh ones.
#[inline(always)]
pub fn exp_share(x: f32) -> f32 {
    const LN_1E_20: f32 = -46.051_7;
    if x < LN_1E_20 { 0.0 } else { exp(x) }
}

/// Zero for a subnormal number: what decays for ever stops there.
#[inline(always)]
pub fn normal(x: f32) -> f32 {
    if x.abs() < f32::MIN_POSITIVE { 0.0 } else { x }
}

/// 1 / (1 + e^−x).
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// tanh x = 1 − 2 / (e^2x + 1): absolute error about 1e-7.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    1.0 - 2.0 / (exp(2.0 * x) + 1.0)
}

/// The error function, absolute error below 4e-7: a rational approximation, odd, exactly ±1 from |x| = 4 on (there the
/// function itself is that close).
#[inline(always)]
pub fn erf(x: f32) -> f32 {
    const ABOVE: [f32; 7] = [
        -2.726_142e-10,
        2.770_681e-8,
        -2.101_024e-6,
        -5.692_506_5e-5,
        -7.349_906e-4,
        -2.954_6e-3,
        -1.609_603_3e-2,
    ];
    const BELOW: [f32; 5] =
        [-1.456_607_2e-5, -2.133_740_6e-4, -1.682_827e-3, -7.373_329_3e-3, -1.426_473_9e-2];
    let x = x.clamp(-4.0, 4.0);
    let square = x * x;
    let above = ABOVE.iter().fold(0.0, |sum: f32, &c| sum.mul_add(square, c));
    let below = BELOW.iter().fold(0.0, |sum: f32, &c| sum.mul_add(square, c));
    (x * above / below).clamp(-1.0, 1.0)
}

/// Numbers worked on together: wide enough for AVX-512, the same everywhere, so that sums are too.
pub const LANES: usize = 16;

/// Up to [`LANES`] numbers of a row, the rest zero. Work on these, unlike work on slices of one buffer, leaves
/// the compiler nothing to suspect of overlapping.
pub type Lanes = [f32; LANES];

/// The `len` numbers that begin at `at`.
#[inline(always)]
pub fn load(from: &[f32], at: usize, len: usize) -> Lanes {
    let mut lanes = [0.0; LANES];
    lanes[..len].copy_from_slice(&from[at..at + len]);
    lanes
}

/// Writes `len` numbers to where `at` is.
#[inline(always)]
pub fn store(lanes: Lanes, to: &mut [f32], at: usize, len: usize) {
    to[at..at + len].copy_from_slice(&lanes[..len]);
}

/// Goes through a range of columns lanes by lanes: `for_lanes!(range, |at, len| { … })`. The body is compiled for whole
/// lanes and for the rest apart: a length that the compiler knows makes a load one instruction.
#[macro_export]
macro_rules! for_lanes {
    ($range:expr, |$at:ident, $len:ident| $body:block) => {{
        let std::ops::Range { start, end } = $range;
        let whole = end - (end - start) % $crate::math::LANES;
        for $at in (start..whole).step_by($crate::math::LANES) {
            let $len = $crate::math::LANES;
            $body
        }
        if whole < end {
            let ($at, $len) = (whole, end - whole);
            $body
        }
    }};
}

/// A function of each lane's number.
#[inline(always)]
pub fn each(f: impl Fn(usize) -> f32) -> Lanes {
    let mut lanes = [0.0; LANES];
    for (lane, x) in lanes.iter_mut().enumerate() {
        *x = f(lane);
    }
    lanes
}

/// Σ aᵢ bᵢ, summed in sixteen lanes.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a_lanes, a_rest) = a.as_chunks::<LANES>();
    let (b_lanes, b_rest) = b.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for (a, b) in a_lanes.iter().zip(b_lanes) {
        for lane in 0..LANES {
            sums[lane] = a[lane].mul_add(b[lane], sums[lane]);
        }
    }
    for (lane, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
        sums[lane] = a.mul_add(*b, sums[lane]);
    }
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            sums[lane] += sums[lane + width];
        }
        width /= 2;
    }
    sums[0]
}

/// y += scale · x.
#[inline(always)]
pub fn add_scaled(y: &mut [f32], scale: f32, x: &[f32]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y = scale.mul_add(*x, *y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn functions_are_close_to_the_real_ones() {
        for step in -8800..=8800 {
            let x = step as f32 * 0.01;
            let real = f64::from(x).exp();
            assert!((f64::from(exp(x)) - real).abs() <= 3e-7 * real || x < -87.0, "exp {x}");
            assert!((f64::from(sigmoid(x)) - 1.0 / (1.0 + f64::from(-x).exp())).abs() < 2e-7, "sigmoid {x}");
            assert!((f64::from(tanh(x)) - f64::from(x).tanh()).abs() < 2e-7, "tanh {x}");
            assert!((f64::from(erf(x)) - libm::erf(f64::from(x))).abs() < 4e-7, "erf {x}");
        }
        assert_eq!((exp(0.0), sigmoid(0.0), tanh(0.0), erf(0.0)), (1.0, 0.5, 0.0, 0.0));
        for x in [f32::MAX, f32::INFINITY, 1e9] {
            assert!(exp(x) > 1e38 && exp(-x) < 1e-37);
            assert_eq!((sigmoid(x), tanh(x), tanh(-x)), (1.0, 1.0, -1.0));
        }
    }

    #[test]
    fn logarithms_are_close_to_the_real_ones() {
        for step in -3000..=3000 {
            let x = (f64::from(step) * 0.02).exp() as f32;
            let real = f64::from(x).ln();
            assert!((f64::from(ln(x)) - real).abs() <= 2e-7 * real.abs().max(1.0), "ln {x}");
        }
        assert_eq!(ln(1.0), 0.0);
        assert!((f64::from(ln(f32::MIN_POSITIVE)) - f64::from(f32::MIN_POSITIVE).ln()).abs() < 1e-5);
    }

    #[test]
    fn sines_and_cosines_are_close_to_the_real_ones() {
        for step in 0..=4096 {
            let v = step as f32 / 4096.0;
            let (sin, cos) = sin_cos_of_turns(v);
            let (real_sin, real_cos) = (std::f64::consts::TAU * f64::from(v)).sin_cos();
            assert!((f64::from(sin) - real_sin).abs() < 2e-7, "sin {v}: {sin} {real_sin}");
            assert!((f64::from(cos) - real_cos).abs() < 2e-7, "cos {v}: {cos} {real_cos}");
        }
    }

    #[test]
    fn a_negligible_share_is_exactly_zero() {
        for x in [-46.06, -80.0, -1e9, f32::NEG_INFINITY] {
            assert_eq!(exp_share(x), 0.0, "{x}");
        }
        for x in [0.0, -1.0, -46.0] {
            assert_eq!(exp_share(x), exp(x), "{x}");
            assert!(exp_share(x) > 0.0, "{x}");
        }
    }

    #[test]
    fn dispatch_changes_no_bit() {
        let xs: Vec<f32> = (0..1000).map(|i| (i as f32 - 500.0) * 0.037).collect();
        let plain: Vec<f32> = xs.iter().map(|&x| exp(x) + tanh(x)).collect();
        vectorized! {
            fn both<'a>(xs: &'a [f32], plain: &'a [f32]) -> (Vec<f32>, f32) {
                (xs.iter().map(|&x| exp(x) + tanh(x)).collect(), dot(xs, plain))
            }
        }
        assert_eq!(both(&xs, &plain), (plain.clone(), dot(&xs, &plain)));
    }

    #[test]
    fn lanes_come_and_go_whole_or_in_part() {
        let from: Vec<f32> = (0..40).map(|i| i as f32).collect();
        for (at, len) in [(0, LANES), (24, LANES), (3, 5), (38, 2)] {
            let lanes = load(&from, at, len);
            assert_eq!(lanes[..len], from[at..at + len]);
            assert!(lanes[len..].iter().all(|&lane| lane == 0.0));
            let mut to = vec![-1.0; 40];
            store(each(|lane| 2.0 * lanes[lane]), &mut to, at, len);
            for (i, &x) in to.iter().enumerate() {
                assert_eq!(x, if (at..at + len).contains(&i) { 2.0 * i as f32 } else { -1.0 });
            }
        }
    }

    #[test]
    fn dot_sums_every_element() {
        for len in [0, 1, 15, 16, 17, 40, 64] {
            let a: Vec<f32> = (0..len).map(|i| i as f32).collect();
            let expected: f32 = (0..len).map(|i| (i * i) as f32).sum();
            assert_eq!(dot(&a, &a), expected);
        }
    }
}
