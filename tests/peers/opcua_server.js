// An OPC UA server of other make: a trace as arrays, and single nodes, of a known signal.
// usage: node opcua_server.js '{"port": 0, "folder": ".", "policies": [...], "users": {...}}'
// "signal": a JSON file with {"pressures": [mbar], "statuses": []} is served over and over instead.
"use strict";
const fs = require("fs");
const path = require("path");
const {
  DataType, DataValue, MessageSecurityMode, SecurityPolicy, StatusCodes, Variant,
  VariantArrayType,
} = require("node-opcua-client");
const { OPCUAServer } = require("node-opcua-server");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

const options = JSON.parse(process.argv[2]);
const DEPTH = 1024;
const began = Date.now(); // PLC time of scan 0
const first = process.hrtime.bigint();
const boot = process.pid & 0xffff;
let newest = -1;
const sequences = new Uint32Array(DEPTH);
const statuses = new Uint16Array(DEPTH);
const pressures = new Float32Array(DEPTH);

const signal = options.signal && JSON.parse(fs.readFileSync(options.signal, "utf8"));
const served = (column, scan) => column[scan % column.length];
const pressure = (scan) => ( // mbar, says which scan it is
  signal ? served(signal.pressures, scan) : 200 + (scan % 4096) * 0.25);
const status = (scan) => (
  signal ? served(signal.statuses, scan) : [0, 1, 0, 2][(scan >> 8) & 3]);

function catchUp() {
  const now = Number((process.hrtime.bigint() - first) / 1000000n);
  for (newest = Math.max(newest, now - DEPTH); newest < now; newest++) {
    const scan = newest + 1;
    const slot = scan % DEPTH;
    statuses[slot] = status(scan);
    pressures[slot] = pressure(scan);
    sequences[slot] = scan;
  }
}

catchUp();

const time = () => {
  const ns = BigInt(began + newest) * 1000000n;
  return [Number(ns >> 32n), Number(ns & 0xffffffffn)];
};
const { Array: ARRAY, Scalar: SCALAR } = VariantArrayType;
const single = (dataType, value) => ({ dataType, arrayType: SCALAR, value });
const array = (dataType, value) => ({ dataType, arrayType: ARRAY, value: value.slice() });
const NODES = {
  "Trace.Sequence": ["UInt32", () => single(DataType.UInt32, newest)],
  "Trace.Time": ["UInt64", () => single(DataType.UInt64, time())],
  "Trace.Boot": ["UInt16", () => single(DataType.UInt16, boot)],
  "Trace.Period": ["UInt16", () => single(DataType.UInt16, 1000)],
  "Trace.Sequences": ["UInt32", () => array(DataType.UInt32, sequences)],
  "Trace.Statuses": ["UInt16", () => array(DataType.UInt16, statuses)],
  "Trace.Pressures": ["Float", () => array(DataType.Float, pressures)],
  "Meas.Pressure": ["Float", () => single(DataType.Float, pressure(newest))],
  "Meas.Supply": ["Int16", () => single(DataType.Int16, 5000)],
  "Cmd.Suction": ["Boolean", () => single(DataType.Boolean, (status(newest) & 1) !== 0)],
  "Cmd.BlowOff": ["Boolean", () => single(DataType.Boolean, (status(newest) & 2) !== 0)],
  "Identification.Model": ["String", () => single(DataType.String, "node-opcua")],
};

function addNodes(space) {
  const namespace = space.registerNamespace("urn:ejector-twin:plc");
  const ejector = namespace.addObject({ browseName: "Ejector", organizedBy: space.rootFolder.objects });
  for (const [name, [dataType, value]] of Object.entries(NODES)) {
    const variable = namespace.addVariable({
      componentOf: ejector,
      browseName: name,
      nodeId: `s=${name}`,
      dataType,
      valueRank: /s$/.test(name) && name.startsWith("Trace") ? 1 : -1,
      minimumSamplingInterval: options.sampling_ms ?? 50,
    });
    variable.bindVariable({
      timestamped_get: () => new DataValue({
        value: new Variant(value()),
        statusCode: StatusCodes.Good,
        sourceTimestamp: new Date(began + newest),
        sourcePicoseconds: 0,
      }),
    });
  }
}

async function main() {
  const manager = new OPCUACertificateManager({
    rootFolder: path.join(options.folder, "node-pki"),
    automaticallyAcceptUnknownCertificate: Boolean(options.trust_all),
  });
  await manager.initialize();
  for (const file of options.trusted ?? []) {
    await manager.trustCertificate(fs.readFileSync(file));
  }
  const policies = options.policies ?? ["None"]; // as our settings name them
  const server = new OPCUAServer({
    port: options.port,
    hostname: "127.0.0.1",
    ...(options.certificate && { certificateFile: options.certificate, privateKeyFile: options.key }),
    serverCertificateManager: manager,
    serverInfo: { applicationUri: options.uri },
    securityPolicies: policies.map((name) => (
      SecurityPolicy[name === "Aes256Sha256RsaPss" ? "Aes256_Sha256_RsaPss" : name])),
    securityModes: [...new Set(policies.map((name) => (
      name === "None" ? MessageSecurityMode.None : MessageSecurityMode.SignAndEncrypt)))],
    allowAnonymous: !options.users,
    userManager: { isValidUser: (name, password) => options.users?.[name] === password },
  });
  await server.initialize();
  addNodes(server.engine.addressSpace);
  await server.start();
  const timer = setInterval(catchUp, 1);
  for (const signal of ["SIGINT", "SIGTERM"]) {
    process.on(signal, async () => {
      clearInterval(timer);
      await server.shutdown(0);
      process.exit(0);
    });
  }
  console.log(`listening on 127.0.0.1:${server.endpoints[0].port}`);
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
