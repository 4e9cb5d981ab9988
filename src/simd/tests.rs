use super::*;
use wide::{f32x8, f64x4};

/// Worst absolute error of sin_cos and sin_cos_pi over a few turns.
fn worst<L: Lanes>() -> f64 {
    let mut worst = 0.0f64;
    for k in 0..40_000 {
        let x = L::from_fn(|lane| L::Real::from_f64(f64::from(k) * 5e-4 - 10.0 + lane as f64 * 1e-5));
        let (sin, cos) = x.sin_cos();
        let (sin_pi, cos_pi) = x.sin_cos_pi();
        for lane in 0..L::LANES {
            let exact = x.lane(lane).to_f64();
            // pi times the argument, reduced exactly before it is rounded.
            let turned = std::f64::consts::PI * (exact - 2.0 * (exact * 0.5).round());
            for (found, expected) in [(sin, exact.sin()), (cos, exact.cos()), (sin_pi, turned.sin()), (cos_pi, turned.cos())] {
                worst = worst.max((found.lane(lane).to_f64() - expected).abs());
            }
        }
    }
    worst
}

#[test]
fn sine_and_cosine() {
    // One and a half (in double precision three) ulps of 1; the reference itself rounds an argument of up to pi.
    assert!(worst::<f32>() < 1.8e-7, "{}", worst::<f32>());
    assert!(worst::<f32x8>() < 1.8e-7, "{}", worst::<f32x8>());
    assert!(worst::<f64>() < 6e-16, "{}", worst::<f64>());
    assert!(worst::<f64x4>() < 6e-16, "{}", worst::<f64x4>());
    assert!(worst::<LanePair<f64x4>>() < 6e-16);
}

#[test]
fn truncation_stays_in_range() {
    let odd = [-1.0, -0.3, 0.0, 3.7, 9.9, 1e30, f32::NAN, f32::NEG_INFINITY];
    let (cells, real) = f32x8::new(odd).truncate(9);
    for lane in 0..8 {
        let cell = f32x8::cell(&cells, lane);
        assert!(cell <= 9);
        assert_eq!(real.to_array()[lane], cell as f32);
        assert!(f64::cell(&f64::from(odd[lane]).truncate(9).0, 0) <= 9);
    }
    assert_eq!(f32x8::cell(&cells, 3), 3);
}

#[test]
fn gathered_components_are_where_they_belong() {
    struct Counting;
    impl<P: NodePair> NodePairReader<P, 1> for Counting {
        fn read_pairs(&self, lane: usize) -> [P; 1] {
            let at = |component: usize| (10 * lane + component) as f32;
            [P::from_nodes([0, 1, 2, 3].map(at), [4, 5, 6, 7].map(at))]
        }
    }
    fn check<L: Gather>() {
        let [rows] = L::gather(&Counting);
        for lane in 0..L::LANES {
            for component in 0..8 {
                assert_eq!(rows[component].lane(lane).to_f64(), (10 * lane + component) as f64);
            }
        }
    }
    check::<f32>();
    check::<f64>();
    check::<f32x8>();
    check::<f64x4>();
}
