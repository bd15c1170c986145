use super::*;
use crate::blocks::testing::{A, Named, assert_close, relu, rows, wide};
use rit_nn::{
    Stock,
    gradcheck::{check_operation, noise, run_operation},
};

const H: usize = 5;

/// Of one or two heads, with task representations of `z` numbers or without.
fn unit(heads: usize, z: usize) -> (Decoder, Named) {
    Named::of(|layout| Decoder::new(layout, "utility", A, H, 4, heads, z))
}

/// Heads, and numbers in a task representation.
const CASES: [(usize, usize); 4] = [(1, 0), (2, 0), (1, 2), (2, 2)];

/// Q of one agent, from its history, its task representation and the actions of those before it, token by token: a start
/// token, then an action each, however often it was chosen before.
fn reference(named: &Named, heads: usize, history: &[f32], z: &[f32], before: &[u8]) -> Vec<f64> {
    let token = |index: usize| {
        let one_hot: Vec<f64> = (0..=A).map(|at| if at == index { 1.0 } else { 0.0 }).collect();
        relu(named.linear("utility.action_embed", &one_hot))
    };
    let mut tokens = vec![token(0)];
    tokens.extend(before.iter().map(|&action| token(1 + usize::from(action))));
    let context = named.attention("utility.action_attention", heads, &wide(history), &tokens);
    let x = [wide(history), context, wide(z)].concat();
    named.linear("utility.head", &relu(named.linear("utility.head_hidden", &x)))
}

/// Q of every row given the actions taken: histories, then representations if there are any.
fn utilities(decoder: &Decoder, tape: &mut Tape<'_>, rows: &Rows, x: &[Var]) -> Var {
    // Tables live as long as the tape.
    let tables: &'static Tables = Box::leak(Box::new(decoder.tables(tape.params)));
    let pass = decoder.prepare(tape, tables, x[0], x.get(1).copied());
    decoder.utilities(tape, rows, pass, &rows.actions)
}

#[test]
fn the_masked_parallel_pass_is_one_agent_after_another() {
    let rows = rows();
    let (history, z) = (noise(2, rows.agent_rows() * H), noise(3, rows.agent_rows() * 2));
    for (heads, dim) in CASES {
        let (decoder, named) = unit(heads, dim);
        let inputs: [(&[f32], usize); 2] = [(&history, H), (&z, 2)];
        let inputs = if dim == 0 { &inputs[..1] } else { &inputs[..] };
        let ours = run_operation(&named.params, inputs, |tape, x| utilities(&decoder, tape, &rows, x));
        let mut theirs = vec![];
        for group in &rows.groups {
            for row in group.queries.clone() {
                let (history, z) = (&history[row * H..][..H], &z[row * 2..][..dim]);
                theirs.extend(reference(&named, heads, history, z, &rows.actions[group.queries.start..row]));
            }
        }
        assert_close(&format!("{heads} heads, representations of {dim}"), &ours, &theirs);
    }
}

#[test]
fn gradients_are_the_numeric_ones() {
    let rows = rows();
    let inputs = [(rows.agent_rows(), H), (rows.agent_rows(), 2)];
    for (heads, dim) in CASES {
        let (decoder, named) = unit(heads, dim);
        let inputs = if dim == 0 { &inputs[..1] } else { &inputs[..] };
        check_operation(named.params.len(), inputs, |tape, x| utilities(&decoder, tape, &rows, x));
    }
}

/// Row after row, each given the greedy actions before it, and never an action that is not available.
#[test]
fn the_greedy_pass_is_one_agent_after_another() {
    let rows = rows();
    let (history, z) = (noise(2, rows.agent_rows() * H), noise(3, rows.agent_rows() * 2));
    let mut differs = false;
    for (heads, dim) in CASES {
        let (decoder, named) = unit(heads, dim);
        let tables = decoder.tables(&named.params);
        let mut tape = Tape::inference(&named.params, Stock::default());
        let of_history = tape.constant(View::dense(&history, H));
        let of_z = (dim > 0).then(|| tape.constant(View::dense(&z, 2)));
        let mut pass = decoder.prepare(&mut tape, &tables, of_history, of_z);
        let ours = decoder.greedy(&named.params, &rows, &mut pass);
        let (mut theirs, mut decided): (Vec<u8>, Vec<f64>) = (vec![], vec![]);
        for group in &rows.groups {
            for row in group.queries.clone() {
                let (history, z) = (&history[row * H..][..H], &z[row * 2..][..dim]);
                let q = reference(&named, heads, history, z, &theirs[group.queries.start..row]);
                let available = (0..A).filter(|action| rows.available[row * A + action] == 1);
                let best = available.max_by(|&a, &b| q[a].total_cmp(&q[b])).unwrap();
                differs |= q.iter().any(|&other| other > q[best]);
                theirs.push(best as u8);
                decided.extend(q);
            }
        }
        assert_eq!(ours, theirs);
        assert_close("utilities as decided", pass.decided(), &decided);
        pass.free(&mut tape);
    }
    assert!(differs, "somewhere the best action is not available");
}
