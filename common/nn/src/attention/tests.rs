use super::{kernels::LARGE, *};
use crate::gradcheck::{check, noise};

const INPUTS: usize = 5;
const DIM: usize = 6;
const QUERIES: usize = 3 + LARGE;
const KEYS: usize = 5 + LARGE + 1;

/// 2 queries over 3 keys, 1 query over 2 keys, and a large group.
fn groups() -> [Group; 3] {
    [
        Group { queries: 0..2, keys: 0..3 },
        Group { queries: 2..3, keys: 3..5 },
        Group { queries: 3..QUERIES, keys: 5..KEYS },
    ]
}

/// Query 1 does not see key 0, query 2 sees none, the large group's queries miss a key each.
fn seen() -> Vec<u8> {
    let large = (0..LARGE * (LARGE + 1)).map(|pair| u8::from(pair % (LARGE + 2) != 0));
    [1, 1, 1, 0, 1, 1, 0, 0].into_iter().chain(large).collect()
}

/// What forward leaves for backward.
struct State {
    queries: Vec<f32>,
    key_values: Vec<f32>,
    weights: Vec<f32>,
}

impl State {
    fn sides(&self, attention: &Attention) -> Sides<'_> {
        attention.sides(View::dense(&self.queries, DIM), View::dense(&self.key_values, 2 * DIM))
    }
}

/// Projections, then attention under these masks.
fn run_masks(
    attention: &Attention,
    params: &[f32],
    xq: &[f32],
    xk: &[f32],
    masks: &[Visible<'_>],
) -> (Vec<f32>, State) {
    let mut state = State {
        queries: vec![9.0; QUERIES * DIM],
        key_values: vec![9.0; KEYS * 2 * DIM],
        weights: vec![9.0; weights_len(&groups(), masks.len(), attention.heads)],
    };
    let mut out = vec![9.0; masks.len() * QUERIES * DIM];
    attention.query.forward(params, View::dense(xq, INPUTS), ViewMut::dense(&mut state.queries, DIM));
    let key_values = ViewMut::dense(&mut state.key_values, 2 * DIM);
    attention.project_keys(params, View::dense(xk, INPUTS), key_values);
    let mut weights = std::mem::take(&mut state.weights);
    forward(state.sides(attention), &groups(), masks, &mut weights, ViewMut::dense(&mut out, DIM));
    (out, State { weights, ..state })
}

fn unit(heads: usize) -> (Attention, usize) {
    let mut layout = LayoutBuilder::default();
    let attention = Attention::new(&mut layout, "attention", INPUTS, DIM, heads);
    (attention, layout.len())
}

/// With any number of heads that split the attention, with ReLU on the values and without.
fn units() -> impl Iterator<Item = (Attention, usize)> {
    [1, 2, 3].into_iter().flat_map(|heads| {
        let (attention, len) = unit(heads);
        let linear = Attention::linear(&mut LayoutBuilder::default(), "attention", INPUTS, DIM, heads);
        [(attention, len), (linear, len)]
    })
}

fn run(
    attention: &Attention,
    params: &[f32],
    xq: &[f32],
    xk: &[f32],
    visible: Visible<'_>,
) -> (Vec<f32>, State) {
    run_masks(attention, params, xq, xk, &[visible])
}

/// Equations 12-14, one number at a time.
fn reference(attention: &Attention, params: &[f32], xq: &[f32], xk: &[f32], seen: &[u8]) -> Vec<f32> {
    let project = |linear: &Linear, x: &[f32]| -> Vec<f32> {
        let mut y = vec![0.0; x.len() / INPUTS * linear.outputs];
        linear.forward(params, View::dense(x, INPUTS), ViewMut::dense(&mut y, linear.outputs));
        y
    };
    let (q, kv) = (project(&attention.query, xq), project(&attention.key_value, xk));
    let head_dim = DIM / attention.heads;
    let mut out = vec![0.0; QUERIES * DIM];
    let mut at = 0;
    for group in groups() {
        for query in group.queries.clone() {
            let flags = &seen[at..at + group.keys.len()];
            at += group.keys.len();
            for column in 0..DIM {
                let head = column / head_dim * head_dim..(column / head_dim + 1) * head_dim;
                let weight = |key: usize| -> f32 {
                    let score: f32 = head.clone().map(|c| q[query * DIM + c] * kv[key * 2 * DIM + c]).sum();
                    (score / (head_dim as f32).sqrt()).exp()
                };
                let keys =
                    || group.keys.clone().zip(flags).filter(|(_, seen)| **seen == 1).map(|(key, _)| key);
                let total: f32 = keys().map(weight).sum();
                let value = |key: usize| match attention.values {
                    Values::Rectified => kv[key * 2 * DIM + DIM + column].max(0.0),
                    Values::Linear => kv[key * 2 * DIM + DIM + column],
                };
                let sum: f32 = keys().map(|key| weight(key) * value(key)).sum();
                out[query * DIM + column] = if total > 0.0 { sum / total } else { 0.0 };
            }
        }
    }
    out
}

#[test]
fn follows_the_equations() {
    for (attention, len) in units() {
        let (params, xq, xk) = (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS));
        let (all, seen) = (vec![1; seen().len()], seen());
        for (visible, seen) in [(Visible::All, &all), (Visible::Where(&seen), &seen)] {
            let (out, _) = run(&attention, &params, &xq, &xk, visible);
            for (a, b) in out.iter().zip(reference(&attention, &params, &xq, &xk, seen)) {
                assert!((a - b).abs() < 1e-5, "{attention:?}: {a} {b}");
            }
        }
    }
}

/// Gradients of queries, keys and parameters.
fn gradients(
    attention: &Attention,
    params: &[f32],
    xq: &[f32],
    xk: &[f32],
    state: &State,
    d_out: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (mut dxq, mut dxk, mut grads) = (vec![9.0; xq.len()], vec![9.0; xk.len()], vec![0.0; params.len()]);
    let (mut d_queries, mut d_key_values) = (vec![9.0; QUERIES * DIM], vec![9.0; KEYS * 2 * DIM]);
    let d = SidesMut {
        queries: ViewMut::dense(&mut d_queries, DIM),
        keys: KeysMut::Together(ViewMut::dense(&mut d_key_values, 2 * DIM)),
        adds: [false; 2],
    };
    backward(state.sides(attention), &groups(), &state.weights, View::dense(d_out, DIM), d);
    let of_values = View::dense(&state.key_values, 2 * DIM);
    attention.rectify_backward(of_values, ViewMut::dense(&mut d_key_values, 2 * DIM));
    // The key's bias has no gradient: softmax cancels it.
    for row in d_key_values.chunks_exact_mut(2 * DIM) {
        linear::add_column_sums(
            View::dense(&row[DIM..], DIM),
            &mut attention.key_value.bias_mut(&mut grads)[DIM..],
        );
    }
    let (to_queries, to_keys) = (ViewMut::dense(&mut dxq, INPUTS), ViewMut::dense(&mut dxk, INPUTS));
    let d_queries = View::dense(&d_queries, DIM);
    attention.query.backward(params, View::dense(xq, INPUTS), d_queries, Some(to_queries), &mut grads);
    let d_key_values = View::dense(&d_key_values, 2 * DIM);
    let of_weight = attention.key_value.weight_mut(&mut grads);
    matmul::dyt_x(d_key_values, View::dense(xk, INPUTS), of_weight, Accum::Add);
    matmul::dy_w(d_key_values, attention.key_value.weight(params), to_keys, Accum::Replace);
    (dxq, dxk, grads)
}

#[test]
fn who_sees_nothing_gets_exactly_zero_and_passes_no_gradient() {
    let (attention, len) = unit(2);
    let (params, xq, xk) = (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS));
    let (out, state) = run(&attention, &params, &xq, &xk, Visible::Where(&seen()));
    assert_eq!(out[2 * DIM..3 * DIM], [0.0; DIM]);
    let (dxq, dxk, _) = gradients(&attention, &params, &xq, &xk, &state, &noise(4, QUERIES * DIM));
    assert_eq!(dxq[2 * INPUTS..3 * INPUTS], [0.0; INPUTS]);
    assert_eq!(dxk[3 * INPUTS..5 * INPUTS], [0.0; 2 * INPUTS]);
}

/// Weights as those of trained networks, which are sure of where to look: what else there is gets exactly nothing,
/// and no gradient of it is subnormal.
#[test]
fn what_weighs_next_to_nothing_weighs_nothing() {
    let (attention, len) = unit(1);
    let large = |seed, len| -> Vec<f32> { noise(seed, len).iter().map(|x| 12.0 * x).collect() };
    let (params, xq, xk) = (large(1, len), large(2, QUERIES * INPUTS), large(3, KEYS * INPUTS));
    let (_, state) = run(&attention, &params, &xq, &xk, Visible::All);
    assert!(state.weights.contains(&0.0) && state.weights.iter().all(|&w| w == 0.0 || w > 1e-21));
    let d_out: Vec<f32> = noise(4, QUERIES * DIM).iter().map(|d| 1e-6 * d).collect();
    let (dxq, dxk, grads) = gradients(&attention, &params, &xq, &xk, &state, &d_out);
    assert!([dxq, dxk, grads].concat().iter().all(|d| !d.is_subnormal()));
}

#[test]
fn gradients_are_the_numeric_ones() {
    let seen = seen();
    for (attention, len) in units() {
        let visible = if attention.heads == 2 { Visible::Where(&seen) } else { Visible::All };
        let (params, xq, xk, to) =
            (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS), noise(4, QUERIES * DIM));
        let loss = |params: &[f32], xq: &[f32], xk: &[f32]| {
            let (out, _) = run(&attention, params, xq, xk, visible);
            out.iter().zip(&to).map(|(out, to)| f64::from(out * to)).sum()
        };
        let (_, state) = run(&attention, &params, &xq, &xk, visible);
        let (dxq, dxk, grads) = gradients(&attention, &params, &xq, &xk, &state, &to);
        check("params", &params, &grads, |params| loss(params, &xq, &xk));
        check("queries", &xq, &dxq, |xq| loss(&params, xq, &xk));
        check("keys", &xk, &dxk, |xk| loss(&params, &xq, xk));
    }
}

/// Three masks over one set of projections: each query's row under a mask is what that mask alone gives, and
/// gradients are the numeric ones of all three together.
#[test]
fn several_masks_are_several_passes() {
    let first = seen();
    let third: Vec<u8> = first.iter().enumerate().map(|(at, seen)| seen ^ u8::from(at % 3 == 0)).collect();
    let masks = [Visible::Where(&first), Visible::All, Visible::Where(&third)];
    for heads in [1, 2] {
        let (attention, len) = unit(heads);
        let (params, xq, xk) = (noise(1, len), noise(2, QUERIES * INPUTS), noise(3, KEYS * INPUTS));
        let to = noise(4, 3 * QUERIES * DIM);
        let run_all = |params: &[f32], xq: &[f32], xk: &[f32]| run_masks(&attention, params, xq, xk, &masks);
        let (out, state) = run_all(&params, &xq, &xk);
        for (mask, visible) in masks.into_iter().enumerate() {
            let (alone, _) = run(&attention, &params, &xq, &xk, visible);
            for query in 0..QUERIES {
                let row = &out[(query * 3 + mask) * DIM..][..DIM];
                for (a, b) in row.iter().zip(&alone[query * DIM..]) {
                    assert!((a - b).abs() < 1e-6, "mask {mask}, query {query}: {a} {b}");
                }
            }
        }
        let loss = |params: &[f32], xq: &[f32], xk: &[f32]| {
            run_all(params, xq, xk).0.iter().zip(&to).map(|(out, to)| f64::from(out * to)).sum()
        };
        let (dxq, dxk, grads) = gradients(&attention, &params, &xq, &xk, &state, &to);
        check("params", &params, &grads, |params| loss(params, &xq, &xk));
        check("queries", &xq, &dxq, |xq| loss(&params, xq, &xk));
        check("keys", &xk, &dxk, |xk| loss(&params, &xq, xk));
    }
}
